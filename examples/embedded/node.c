/* A node of a run in C, on zenoh-pico: a client of the coordinator, which passes on what it says. See README.md.

   PEAKMESH_RUN and PEAKMESH_CONNECT say where. It ends with 0 after a run that came to its end and is recorded, 3 after any
   other, 2 where it cannot take part, and 128 and the number of a signal that asked it to end.

   Zenoh's threads fill in what comes, by step, and wake the main thread, which does all else. All memory is fixed. */
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#include <zenoh-pico.h>

#include THIS_NODE /* node_2_run.h, of `peakmesh export --c --node 2` */
#include "wire.h"

enum {
    AHEAD = 64, /* steps of which messages are kept, those to come and our own; the run's window must be smaller */
    LONGEST = 4096, /* bytes of what comes in: what zenoh-pico puts together */
    MESSAGE = 512 + WIRE_NUMBER * (THIS_NX + THIS_NY + THIS_NZ) + 67 * (THIS_SENDERS + 1), /* bytes of what goes out */
    STAMP = 16 + 128 + 1 + 16 + 8,
    QUERIES = 8, /* that wait for an answer */
    JOIN_SECONDS = 120,
    SILENCE_SECONDS = 60, /* after which the coordinator is taken for lost */
    FAREWELL_SECONDS = 2 /* for the recorder to have our messages, where we are asked to go */
};
#define WHO "node-" THIS_NAME
static const uint64_t DELIVERIES = 4; /* the stream of those draws */

typedef struct {
    long long step;
    int index, count; /* the mode; how many numbers */
    this_real first[THIS_NX > THIS_NY ? THIS_NX : THIS_NY], second[THIS_NY_MOST];
} heard_t;

typedef struct {
    size_t size, stamp_size;
    char payload[MESSAGE];
    uint8_t stamp[STAMP];
} sent_t;

/* What the threads share; `lock` is never held while something is sent. */
static z_owned_mutex_t lock;
static z_owned_condvar_t changed;
static heard_t modes[AHEAD], measured[AHEAD], told[THIS_SENDERS][AHEAD];
static struct {
    unsigned char coordinator, recorder, node[THIS_NODES];
} present;
static char recorders_session[128];
static struct {
    int started, closed, stopped, recorded, broken_off;
    long long steps, window;
    uint64_t seed, received;
    double period;
    char reason[256];
} run;
static z_owned_query_t queries[QUERIES];
static int asked, joins, is_lost, is_taken;
static time_t last_heard;

static z_owned_session_t session;
static z_owned_publisher_t publisher;
static sent_t outbox[AHEAD];
static uint64_t number, words;
static char base[160], identity[96];
static atomic_int signalled;
static int is_leaving;

/* reading */
static const char *after(const char *text, const char *field)
{
    const char *found = text ? strstr(text, field) : NULL;
    return found ? found + strlen(field) : NULL;
}

static long long whole(const char *text, const char *field, long long otherwise)
{
    const char *value = after(text, field);
    return value ? strtoll(value, NULL, 10) : otherwise;
}

/* The numbers of an array; how many, -1 where there are more than `most`, or none at all is there. */
static int numbers(const char *text, const char *field, this_real *values, int most)
{
    const char *at = after(text, field);
    int n = 0;
    if (!at)
        return -1;
    while (*at != ']') {
        char *end;
        double value = strtod(at, &end);
        if (end == at || n == most)
            return -1;
        values[n++] = (this_real)value;
        at = *end == ',' ? end + 1 : end;
    }
    return n;
}

/* A sample as text; its length, 0 where it is too long to be read. */
static size_t read_text(const z_loaned_bytes_t *bytes, char text[LONGEST])
{
    z_bytes_reader_t reader = z_bytes_get_reader(bytes);
    size_t size = z_bytes_len(bytes) < LONGEST ? z_bytes_reader_read(&reader, (uint8_t *)text, LONGEST - 1) : 0;
    text[size] = 0;
    return size;
}

/* what comes, on zenoh's threads */
static void wake(void)
{
    last_heard = time(NULL);
    z_condvar_signal(z_loan_mut(changed));
    z_mutex_unlock(z_loan_mut(lock));
}

static void keep(heard_t slots[AHEAD], const heard_t *message)
{
    z_mutex_lock(z_loan_mut(lock));
    if (message->step >= 0)
        slots[message->step % AHEAD] = *message;
    wake();
}

static void on_mode(z_loaned_sample_t *sample, void *context)
{
    char text[LONGEST];
    heard_t message = {.index = 0};
    const char *name;
    (void)context;
    read_text(z_sample_payload(sample), text);
    message.step = whole(text, "\"step\":", -1);
    name = after(text, "\"mode\":\"");
    for (; message.index < THIS_MODES; message.index++) {
        size_t length = strlen(this_modes[message.index]);
        if (name && !strncmp(name, this_modes[message.index], length) && name[length] == '"')
            break;
    }
    if (message.index < THIS_MODES)
        keep(modes, &message);
}

static void on_measurement(z_loaned_sample_t *sample, void *context)
{
    char text[LONGEST];
    heard_t message = {.index = 0};
    (void)context;
    read_text(z_sample_payload(sample), text);
    message.step = whole(text, "\"step\":", -1);
    message.count = numbers(text, "\"y\":[", message.first, THIS_NY);
    if (message.count == THIS_NY || message.count == 0)
        keep(measured, &message);
}

static void on_estimate(z_loaned_sample_t *sample, void *context)
{
    char text[LONGEST];
    heard_t message = {.index = 0};
    size_t sender = (size_t)(uintptr_t)context;
    read_text(z_sample_payload(sample), text);
    message.step = whole(text, "\"step\":", -1);
    if (numbers(text, "\"x_hat\":[", message.first, THIS_NX) == THIS_NX &&
        numbers(text, "\"innovation\":[", message.second, this_ny[sender]) == this_ny[sender])
        keep(told[sender], &message);
}

static void on_control(z_loaned_sample_t *sample, void *context)
{
    char text[LONGEST];
    const char *reason, *period, *begins;
    size_t i;
    (void)context;
    read_text(z_sample_payload(sample), text);
    z_mutex_lock(z_loan_mut(lock));
    begins = after(after(text, "\"cast\":{"), "\"" WHO "\":\""); /* the session that begins under our name */
    if (strstr(text, "\"order\":\"start\"") && begins &&
        (strncmp(begins, identity, strlen(identity)) || begins[strlen(identity)] != '"'))
        is_taken = 1;
    else if (strstr(text, "\"order\":\"start\"") && begins) {
        run.steps = whole(text, "\"steps\":", 0);
        run.window = whole(text, "\"window\":", AHEAD);
        run.seed = (uint64_t)whole(text, "\"seed\":", 0);
        period = after(text, "\"period\":");
        run.period = period ? strtod(period, NULL) : 0.0;
        run.started = 1;
    } else if (strstr(text, "\"order\":\"close\""))
        run.closed = 1;
    else if (strstr(text, "\"order\":\"stop\"")) {
        reason = after(text, "\"reason\":\"");
        for (i = 0; reason && *reason && *reason != '"' && i < sizeof run.reason - 1; reason++) {
            if (*reason == '\\' && reason[1]) /* what is escaped is a quotation mark */
                reason++;
            run.reason[i++] = *reason == '"' ? '\'' : *reason;
        }
        run.stopped = 1;
    }
    wake();
}

static void on_acknowledged(z_loaned_sample_t *sample, void *context)
{
    char text[LONGEST];
    long long received;
    (void)context;
    read_text(z_sample_payload(sample), text);
    received = whole(after(text, "\"received\":{"), "\"" WHO "\":", 0);
    z_mutex_lock(z_loan_mut(lock));
    if (received > 0 && (uint64_t)received > run.received)
        run.received = (uint64_t)received;
    run.recorded = run.recorded || strstr(text, "\"closed\":true");
    run.broken_off = run.broken_off || strstr(text, "\"broken_off\":{");
    wake();
}

/* Somebody has come or gone: peakmesh/RUN/session/WHO/ID. */
static void on_session(z_loaned_sample_t *sample, void *context)
{
    char text[256];
    z_view_string_t key;
    const char *who, *id;
    unsigned char is_there = z_sample_kind(sample) == Z_SAMPLE_KIND_PUT;
    int j;
    (void)context;
    z_keyexpr_as_view_string(z_sample_keyexpr(sample), &key);
    snprintf(text, sizeof text, "%.*s", (int)z_string_len(z_loan(key)), z_string_data(z_loan(key)));
    who = after(text, "/session/");
    if (!who || !(id = strchr(who, '/')))
        return;
    text[id++ - text] = 0;
    z_mutex_lock(z_loan_mut(lock));
    if (!strcmp(who, "coordinator")) {
        joins = joins || is_there;
        is_lost = is_lost || (present.coordinator && !is_there);
        present.coordinator = is_there;
    } else if (!strcmp(who, "recorder")) {
        present.recorder = is_there;
        snprintf(recorders_session, sizeof recorders_session, "%s", is_there ? id : "");
    } else if (!strncmp(who, "node-", 5))
        for (j = 0; j < THIS_NODES; j++)
            if (!strcmp(who + 5, this_nodes[j]))
                present.node[j] = is_there;
    wake();
}

static void on_refused(z_loaned_sample_t *sample, void *context)
{
    (void)sample;
    (void)context;
    z_mutex_lock(z_loan_mut(lock));
    is_taken = 1;
    wake();
}

/* The recorder lacks something. The main thread answers: this one must go on reading. */
static void on_query(z_loaned_query_t *query, void *context)
{
    (void)context;
    z_mutex_lock(z_loan_mut(lock));
    if (asked < QUERIES)
        z_query_clone(&queries[asked++], query);
    wake();
}

static void on_signal(int which)
{
    signalled = which;
}

/* saying */
static const z_loaned_keyexpr_t *key_of(char text[320], z_view_keyexpr_t *key, const char *format, ...)
{
    va_list arguments;
    int n = snprintf(text, 320, "%s", base);
    va_start(arguments, format);
    vsnprintf(text + n, 320 - (size_t)n, format, arguments);
    va_end(arguments);
    z_view_keyexpr_from_str(key, text);
    return z_loan(*key);
}

/* A word that runs the run, with our session and its number. `rest` begins with a comma, if it is not empty. */
static void say(const char *topic, const char *rest)
{
    char text[LONGEST], name[320];
    z_view_keyexpr_t key;
    z_owned_bytes_t payload;
    z_put_options_t options;
    snprintf(text, sizeof text, "{\"session\":\"%s\",\"number\":%llu,\"who\":\"" WHO "\"%s}", identity,
             (unsigned long long)words++, rest);
    z_put_options_default(&options);
    options.congestion_control = Z_CONGESTION_CONTROL_BLOCK; /* else what has no room is dropped */
    z_bytes_copy_from_str(&payload, text);
    z_put(z_loan(session), key_of(name, &key, "%s/" WHO, topic), z_move(payload), &options);
}

static void leave(int code, const char *format, ...)
{
    char reason[400], rest[440];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(reason, sizeof reason, format, arguments);
    va_end(arguments);
    fprintf(stderr, "%s\n", reason);
    if (present.coordinator) {
        snprintf(rest, sizeof rest, ",\"reason\":\"%s\"", reason);
        say("leaving", rest);
    }
    z_drop(z_move(session));
    exit(code);
}

static void answer(z_owned_query_t *query, uint64_t received)
{
    z_view_string_t parameters;
    char text[256], name[320];
    const char *by;
    long long first;
    uint64_t n;
    z_query_parameters(z_loan(*query), &parameters);
    snprintf(text, sizeof text, "%.*s", (int)z_string_len(z_loan(parameters)), z_string_data(z_loan(parameters)));
    first = whole(text, "from=", -1);
    by = after(text, "by=");
    if (first >= 0 && by && *recorders_session && !strncmp(by, recorders_session, strlen(recorders_session)))
        for (n = received > (uint64_t)first ? received : (uint64_t)first; n < number; n++) {
            const sent_t *sent = &outbox[n % AHEAD];
            z_view_keyexpr_t key;
            z_owned_bytes_t payload, stamp;
            z_query_reply_options_t options;
            z_query_reply_options_default(&options);
            z_bytes_copy_from_buf(&payload, (const uint8_t *)sent->payload, sent->size);
            z_bytes_copy_from_buf(&stamp, sent->stamp, sent->stamp_size);
            options.attachment = z_move(stamp);
            z_query_reply(z_loan(*query), key_of(name, &key, "node/" THIS_NAME "/estimate"), z_move(payload), &options);
        }
    z_drop(z_move(*query));
}

/* Number a message, sign it, keep it until the recorder has it, send it. */
static void publish(const char *payload, size_t size)
{
    static const char topic[] = "node/" THIS_NAME "/estimate"; /* its zero is signed, too */
    char together[sizeof topic + MESSAGE];
    sent_t *sent = &outbox[number % AHEAD];
    struct timespec now;
    uint64_t time_ns;
    size_t i, n = 16 + strlen(WHO) + 1;
    z_owned_bytes_t body, stamp;
    z_publisher_put_options_t options;
    clock_gettime(CLOCK_REALTIME, &now);
    time_ns = (uint64_t)now.tv_sec * 1000000000U + (uint64_t)now.tv_nsec;
    for (i = 0; i < 8; i++) {
        sent->stamp[i] = (uint8_t)(number >> 8 * i);
        sent->stamp[8 + i] = (uint8_t)(time_ns >> 8 * i);
    }
    memcpy(sent->stamp + 16, WHO, strlen(WHO) + 1);
    memcpy(together, topic, sizeof topic);
    memcpy(together + sizeof topic, payload, size);
    wire_digest(sent->stamp + n, 16, together, sizeof topic + size);
    wire_digest(sent->stamp + n + 16, 8, identity, strlen(identity));
    sent->stamp_size = n + 24;
    memcpy(sent->payload, payload, size);
    sent->size = size;
    number++;
    z_publisher_put_options_default(&options);
    z_bytes_copy_from_buf(&body, (const uint8_t *)payload, size);
    z_bytes_copy_from_buf(&stamp, sent->stamp, sent->stamp_size);
    options.attachment = z_move(stamp);
    z_publisher_put(z_loan(publisher), z_move(body), &options);
}

/* the main thread */
static int all_are_there(void)
{
    int j, there = present.coordinator && present.recorder;
    for (j = 0; j < THIS_NODES; j++)
        there = there && present.node[j];
    return there;
}

static int has_started(void)
{
    return run.started;
}

static int is_recorded(void)
{
    return run.recorded || !present.recorder;
}

static int is_received(void)
{
    return run.received >= number;
}

static int never(void)
{
    return 0;
}

static int wait_until(int (*condition)(void), int seconds);

/* The run has ended, and we stay until the recorder has all of ours. */
static void end(int is_stopped)
{
    is_leaving = 1;
    wait_until(is_recorded, SILENCE_SECONDS);
    if (is_stopped)
        leave(3, "%s", run.reason);
    if (!run.recorded || run.broken_off || run.received < number)
        leave(3, "the recorder has not got all of ours");
    z_drop(z_move(session));
    exit(0);
}

static void asked_to_go(int which)
{
    is_leaving = 1;
    wait_until(is_received, FAREWELL_SECONDS);
    leave(128 + which, "asked to end");
}

/* Do what is to be done of what has come. */
static void heed(void)
{
    z_owned_query_t query;
    int has_query, has_to_join, is_over, is_stopped;
    uint64_t received;
    z_mutex_lock(z_loan_mut(lock));
    if ((has_query = asked > 0))
        query = queries[--asked];
    has_to_join = joins;
    joins = 0;
    is_stopped = run.stopped;
    is_over = run.closed || run.stopped;
    received = run.received;
    z_mutex_unlock(z_loan_mut(lock));
    if (has_query)
        answer(&query, received);
    if (has_to_join)
        say("joining", ",\"version\":\"" THIS_VERSION "\",\"listen\":\"none\",\"machine\":\"\",\"lease\":1e9,\"lacks\":[]");
    if (is_leaving)
        return;
    if (is_taken)
        leave(2, "node " THIS_NAME " takes part already; start it once");
    if (is_over)
        end(is_stopped);
    if (is_lost || z_session_is_closed(z_loan(session)))
        leave(3, "the coordinator was lost");
    if (signalled)
        asked_to_go(signalled);
}

/* Until the condition holds; 0 where nothing was heard for so many seconds. */
static int wait_until(int (*condition)(void), int seconds)
{
    time_t began = time(NULL), heard;
    int holds;
    do {
        z_clock_t soon = z_clock_now();
        z_clock_advance_ms(&soon, 100); /* to look after signals */
        heed();
        z_mutex_lock(z_loan_mut(lock));
        if (!(holds = condition()) && !asked && !joins)
            z_condvar_wait_until(z_loan_mut(changed), z_loan_mut(lock), &soon);
        heard = last_heard > began ? last_heard : began;
        z_mutex_unlock(z_loan_mut(lock));
    } while (!holds && time(NULL) <= heard + seconds);
    return holds;
}

static heard_t *awaited; /* slots, of which that of `step` is waited for */
static long long step;

static int has_come(void)
{
    return awaited[step % AHEAD].step == step;
}

static const heard_t *next(heard_t slots[AHEAD])
{
    awaited = slots;
    if (!wait_until(has_come, SILENCE_SECONDS))
        leave(3, "nothing was heard for %d s", SILENCE_SECONDS);
    return &slots[step % AHEAD];
}

/* joining */
static void subscribe(void (*hear)(z_loaned_sample_t *, void *), size_t context, const char *format, const char *name)
{
    char text[320];
    z_view_keyexpr_t key;
    z_owned_closure_sample_t closure;
    z_closure(&closure, hear, NULL, (void *)(uintptr_t)context);
    if (z_declare_background_subscriber(z_loan(session), key_of(text, &key, format, name), z_move(closure), NULL) < 0)
        leave(3, "cannot subscribe to %s", text);
}

static void declare(void)
{
    char text[320];
    z_view_keyexpr_t key;
    z_owned_closure_query_t answers;
    z_owned_closure_sample_t sees;
    z_publisher_options_t options;
    z_liveliness_subscriber_options_t history;
    size_t j;
    subscribe(on_mode, 0, "%s", "mode"); /* first what we hear, then what we say, that we are there last */
    subscribe(on_measurement, 0, "node/%s/measurement", THIS_NAME);
    for (j = 0; j < THIS_SENDERS; j++)
        if (j != THIS_SELF)
            subscribe(on_estimate, j, "node/%s/estimate", this_senders[j]);
    subscribe(on_control, 0, "%s", "control");
    subscribe(on_acknowledged, 0, "%s", "acknowledged");
    subscribe(on_refused, 0, "refused/" WHO "/%s", identity);
    z_liveliness_subscriber_options_default(&history);
    history.history = true;
    z_closure(&sees, on_session, NULL, NULL);
    z_liveliness_declare_background_subscriber(z_loan(session), key_of(text, &key, "session/*/*"), z_move(sees), &history);
    z_closure(&answers, on_query, NULL, NULL);
    z_declare_background_queryable(z_loan(session), key_of(text, &key, "replay/" WHO), z_move(answers), NULL);
    z_publisher_options_default(&options);
    options.congestion_control = Z_CONGESTION_CONTROL_BLOCK; /* which a client alone heeds */
    options.is_express = true; /* others wait for it */
    z_declare_publisher(z_loan(session), &publisher, key_of(text, &key, "node/" THIS_NAME "/estimate"), &options);
}

static void appear(void)
{
    static z_owned_liveliness_token_t of_session, of_name;
    char text[320];
    z_view_keyexpr_t key;
    z_liveliness_declare_token(z_loan(session), &of_session, key_of(text, &key, "session/" WHO "/%s", identity), NULL);
    z_liveliness_declare_token(z_loan(session), &of_name, key_of(text, &key, "alive/" WHO), NULL);
}

static int is_open(const char *address)
{
    z_owned_config_t config;
    z_config_default(&config);
    zp_config_insert(z_loan_mut(config), Z_CONFIG_MODE_KEY, "client");
    zp_config_insert(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, address);
    return z_open(&session, z_move(config), NULL) == Z_OK;
}

/* the run */
static size_t put_numbers(char *text, const char *name, const this_real *values, int n)
{
    size_t at = (size_t)sprintf(text, "\"%s\":[", name);
    int i;
    for (i = 0; i < n; i++) {
        if (i)
            text[at++] = ',';
        at += wire_number(text + at, (double)values[i]);
    }
    return at + (size_t)sprintf(text + at, "],");
}

/* Whose message of this step is lost in the model: it is there, and counts as if it were not. */
static void lose(unsigned char is_lost_of[THIS_SENDERS])
{
    int l;
    memset(is_lost_of, 0, THIS_SENDERS);
    for (l = 0; l < THIS_LOSSY; l++)
        if (wire_draw(run.seed, DELIVERIES, (uint64_t)step, THIS_DRAWS, this_links[l].draw) >= this_links[l].arrives)
            is_lost_of[this_links[l].sender] = 1;
}

static void take_part(void)
{
    static this_state node;
    char text[MESSAGE], made[MESSAGE] = "\"mode\":\"\",\"heard\":[]}";
    unsigned char is_lost_of[THIS_SENDERS];
    this_real z_hat[THIS_NZ];
    const heard_t *message;
    size_t size, at, j;
    int mode;
    this_init(&node);
    for (step = 0; step < run.steps; step++) {
        message = next(measured);
        this_innovation(&node, message->count ? message->first : NULL);
        this_z_hat(&node, z_hat);
        size = (size_t)sprintf(text, "{\"step\":%lld,", step);
        size += put_numbers(text + size, "x_hat", node.from[THIS_SELF].x_hat, THIS_NX);
        size += put_numbers(text + size, "innovation", node.from[THIS_SELF].innovation, THIS_NY);
        size += put_numbers(text + size, "z_hat", z_hat, THIS_NZ);
        size += (size_t)sprintf(text + size, "%s", made);
        publish(text, size);
        mode = next(modes)->index;
        lose(is_lost_of);
        at = (size_t)sprintf(made, "\"mode\":\"%s\",\"heard\":[", this_modes[mode]);
        for (j = 0; j < THIS_SENDERS; j++) {
            if (!this_hears[mode][j])
                continue;
            if (j != THIS_SELF) {
                message = next(told[j]);
                memcpy(node.from[j].x_hat, message->first, sizeof node.from[j].x_hat);
                memcpy(node.from[j].innovation, message->second, sizeof node.from[j].innovation);
                node.from[j].heard = !is_lost_of[j];
            }
            if (!is_lost_of[j])
                at += (size_t)sprintf(made + at, "%s\"%s\"", made[at - 1] == '[' ? "" : ",", this_senders[j]);
        }
        sprintf(made + at, "]}");
        if (this_step(&node, mode) != THIS_MADE)
            leave(3, "the estimate of step %lld would be infinite", step + 1);
    }
    wait_until(never, SILENCE_SECONDS);
    leave(3, "the run did not end");
}

static void forget_all(heard_t slots[AHEAD])
{
    int i;
    for (i = 0; i < AHEAD; i++)
        slots[i].step = -1;
}

int main(void)
{
    const char *name = getenv("PEAKMESH_RUN"), *address = getenv("PEAKMESH_CONNECT"), *node = getenv("PEAKMESH_NODE");
    struct timespec now;
    time_t began = time(NULL);
    char rest[128];
    size_t j;
    if (!name || !address || strlen(name) > 128 || (node && strcmp(node, THIS_NAME))) {
        fprintf(stderr, "this is node " THIS_NAME "; PEAKMESH_RUN and PEAKMESH_CONNECT say where the run is\n");
        return 2;
    }
    signal(SIGTERM, on_signal);
    signal(SIGINT, on_signal);
    z_mutex_init(&lock);
    z_condvar_init(&changed);
    forget_all(modes);
    forget_all(measured);
    for (j = 0; j < THIS_SENDERS; j++)
        forget_all(told[j]);
    clock_gettime(CLOCK_REALTIME, &now);
    snprintf(base, sizeof base, "peakmesh/%s/", name);
    snprintf(identity, sizeof identity, "%011lld%09ld-%ld", (long long)now.tv_sec, now.tv_nsec, (long)getpid());
    while (!is_open(address)) {
        if (signalled)
            return 128 + signalled;
        if (time(NULL) > began + JOIN_SECONDS) {
            fprintf(stderr, "nobody answers at %s\n", address);
            return 3;
        }
        z_sleep_ms(100);
    }
    declare();
    appear();
    if (!wait_until(all_are_there, JOIN_SECONDS))
        leave(3, "the others did not join the run");
    snprintf(rest, sizeof rest, ",\"gains\":\"" THIS_GAINS "\"");
    say("ready", rest);
    if (!wait_until(has_started, JOIN_SECONDS))
        leave(3, "the coordinator did not start the run");
    if (run.period > 0.0 || run.window >= AHEAD)
        leave(3, "this node takes part in lock-step alone, with a window below %d", AHEAD);
    take_part();
}
