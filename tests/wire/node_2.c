/* Node 2 of a wire file, as `peakmesh export --c` has made it: hears what stands there, and must say what stands there. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "node_2.h"

#define LONGEST 65536

static const char *const names[] = {"1", "2", "3", "4"};
static const int places[] = {NODE_2_FROM_1, NODE_2_SELF, NODE_2_FROM_3, NODE_2_FROM_4};
static const int modes[] = {NODE_2_MODE_1, NODE_2_MODE_2, NODE_2_MODE_3, NODE_2_MODE_4};
static long compared, differ;

static void stop(const char *why, const char *line) {
    fprintf(stderr, "%s: %.100s\n", why, line);
    exit(2);
}

/* The numbers of a field. */
static void numbers(const char *payload, const char *field, double *values, int count) {
    char begin[32];
    const char *at;
    snprintf(begin, sizeof begin, "\"%s\":[", field);
    if ((at = strstr(payload, begin)) == NULL) stop("there is no such field", begin);
    for (at += strlen(begin); count > 0; --count, ++values) {
        char *end;
        *values = strtod(at, &end);
        if (end == at) stop("there is no number", at);
        at = end + (*end == ',');
    }
}

/* What node 2 says, against what it must say. */
static void compare(const char *payload, const char *field, const double *values, int count) {
    double wanted[8];
    int i;
    numbers(payload, field, wanted, count);
    for (i = 0; i < count; ++i, ++compared)
        if (memcmp(&values[i], &wanted[i], sizeof *values) != 0 && ++differ)
            printf("%s[%d] is %a, must be %a: %.20s\n", field, i, values[i], wanted[i], payload);
}

static int named(const char *text, const char *after) {
    int i;
    if (strncmp(text, after, strlen(after)) != 0) return -1;
    for (i = 0; i < 4; ++i)
        if (strncmp(text + strlen(after), names[i], 1) == 0) return i;
    stop("there is no such name", text);
    return -1;
}

int main(int argc, char **argv) {
    static char line[LONGEST];
    node_2_state node;
    double y[NODE_2_NY], z_hat[NODE_2_NZ];
    int mode = -1, sender;
    FILE *file = argc > 1 ? fopen(argv[1], "r") : NULL;
    if (file == NULL) stop("there is no file", argc > 1 ? argv[1] : "");
    node_2_init(&node);
    while (fgets(line, sizeof line, file) != NULL) {
        const char *topic = line + strlen("<\tpeakmesh/wire/"), *payload = strchr(topic, '\t') + 1;
        if (strncmp(topic, "mode\t", 5) == 0) {
            if (mode >= 0 && node_2_step(&node, modes[mode]) != NODE_2_MADE) stop("it makes no step", line);
            mode = named(strstr(payload, "\"mode\""), "\"mode\":\"");
        } else if (strncmp(topic, "node/2/measurement\t", 19) == 0) {
            numbers(payload, "y", y, NODE_2_NY);
            node_2_innovation(&node, y);
        } else if ((sender = named(topic, "node/")) >= 0) {
            node_2_pair *pair = &node.from[places[sender]];
            if (line[0] == '<') { /* each of these has as many measurements as node 2 */
                numbers(payload, "x_hat", pair->x_hat, NODE_2_NX);
                numbers(payload, "innovation", pair->innovation, NODE_2_NY);
                pair->heard = 1;
            } else {
                node_2_z_hat(&node, z_hat);
                compare(payload, "x_hat", pair->x_hat, NODE_2_NX);
                compare(payload, "innovation", pair->innovation, NODE_2_NY);
                compare(payload, "z_hat", z_hat, NODE_2_NZ);
            }
        }
    }
    fclose(file);
    printf("%ld numbers, %ld differ\n", compared, differ);
    return differ != 0 || compared == 0;
}
