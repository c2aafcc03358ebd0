#include "wire.h"

#include <float.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* numbers */
static size_t digits_of(char digits[24], int *exponent, double value)
{
    char text[40];
    size_t n = 0;
    int precision;
    const char *c;
    for (precision = value < DBL_MIN ? 0 : 14; precision < 17; precision++) { /* 17 digits tell all apart */
        snprintf(text, sizeof text, "%.*e", precision, value);
        if (strtod(text, NULL) == value)
            break;
        text[precision + 1]++; /* of a power of two the next above may be read back where the nearest is not */
        if (precision == 15 && strtod(text, NULL) == value)
            break;
    }
    for (c = text; *c != 'e'; c++)
        if (*c >= '0' && *c <= '9')
            digits[n++] = *c;
    *exponent = (int)strtol(c + 1, NULL, 10);
    while (n > 1 && digits[n - 1] == '0')
        n--;
    return n;
}

size_t wire_number(char text[WIRE_NUMBER], double value)
{
    char digits[24];
    int exponent, place;
    size_t n = 1, at = 0, i;
    if (value < 0.0 || (value == 0.0 && 1.0 / value < 0.0))
        text[at++] = '-';
    if (value == 0.0) {
        digits[0] = '0';
        exponent = 0;
    } else
        n = digits_of(digits, &exponent, value < 0.0 ? -value : value);
    if (exponent >= 0 && exponent < 16) {
        for (i = 0; i < n || (int)i <= exponent; i++) {
            if ((int)i == exponent + 1)
                text[at++] = '.';
            text[at++] = i < n ? digits[i] : '0';
        }
        if ((int)n <= exponent + 1) {
            text[at++] = '.';
            text[at++] = '0';
        }
    } else if (exponent < 0 && exponent >= -5) {
        text[at++] = '0';
        text[at++] = '.';
        for (place = -1; place > exponent; place--)
            text[at++] = '0';
        for (i = 0; i < n; i++)
            text[at++] = digits[i];
    } else {
        text[at++] = digits[0];
        for (i = 1; i < n; i++) {
            if (i == 1)
                text[at++] = '.';
            text[at++] = digits[i];
        }
        at += (size_t)snprintf(text + at, WIRE_NUMBER - at, "e%+d", exponent);
    }
    text[at] = 0;
    return at;
}

/* digests */
static const uint64_t START[8] = {
    0x6a09e667f3bcc908, 0xbb67ae8584caa73b, 0x3c6ef372fe94f82b, 0xa54ff53a5f1d36f1,
    0x510e527fade682d1, 0x9b05688c2b3e6c1f, 0x1f83d9abfb41bd6b, 0x5be0cd19137e2179,
};
static const uint8_t ORDER[10][16] = {
    {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}, {14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3},
    {11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4}, {7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8},
    {9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13}, {2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9},
    {12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11}, {13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10},
    {6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5}, {10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0},
};

static uint64_t turned(uint64_t word, unsigned by)
{
    return word >> by | word << (64 - by);
}

static void mix(uint64_t v[16], size_t a, size_t b, size_t c, size_t d, uint64_t x, uint64_t y)
{
    v[a] += v[b] + x;
    v[d] = turned(v[d] ^ v[a], 32);
    v[c] += v[d];
    v[b] = turned(v[b] ^ v[c], 24);
    v[a] += v[b] + y;
    v[d] = turned(v[d] ^ v[a], 16);
    v[c] += v[d];
    v[b] = turned(v[b] ^ v[c], 63);
}

static void compress(uint64_t h[8], const uint8_t block[128], uint64_t counted, int is_last)
{
    uint64_t v[16], m[16];
    size_t i, b, round;
    for (i = 0; i < 8; i++) {
        v[i] = h[i];
        v[i + 8] = START[i];
    }
    v[12] ^= counted;
    if (is_last)
        v[14] = ~v[14];
    for (i = 0; i < 16; i++)
        for (m[i] = 0, b = 0; b < 8; b++)
            m[i] |= (uint64_t)block[8 * i + b] << 8 * b;
    for (round = 0; round < 12; round++) {
        const uint8_t *s = ORDER[round % 10];
        for (i = 0; i < 4; i++)
            mix(v, i, i + 4, i + 8, i + 12, m[s[2 * i]], m[s[2 * i + 1]]);
        for (i = 0; i < 4; i++)
            mix(v, i, (i + 1) % 4 + 4, (i + 2) % 4 + 8, (i + 3) % 4 + 12, m[s[8 + 2 * i]], m[s[9 + 2 * i]]);
    }
    for (i = 0; i < 8; i++)
        h[i] ^= v[i] ^ v[i + 8];
}

void wire_digest(uint8_t *digest, size_t size, const void *data, size_t length)
{
    const uint8_t *bytes = data;
    uint8_t block[128];
    uint64_t h[8], counted = 0;
    size_t i, part;
    memcpy(h, START, sizeof h);
    h[0] ^= 0x01010000U ^ size;
    do {
        part = length < sizeof block ? length : sizeof block;
        memset(block, 0, sizeof block);
        memcpy(block, bytes, part);
        bytes += part;
        length -= part;
        counted += part;
        compress(h, block, counted, length == 0);
    } while (length);
    for (i = 0; i < size; i++)
        digest[i] = (uint8_t)(h[i / 8] >> 8 * (i % 8));
}

/* draws */
static uint64_t high_half(uint64_t a, uint64_t b)
{
    uint64_t low = UINT32_MAX, middle = (a & low) * (b >> 32) + ((a & low) * (b & low) >> 32);
    uint64_t other = (a >> 32) * (b & low) + (middle & low);
    return (a >> 32) * (b >> 32) + (middle >> 32) + (other >> 32);
}

double wire_draw(uint64_t seed, uint64_t stream, uint64_t step, unsigned of, unsigned place)
{
    const uint64_t P = 0xD2E7470EE14C6C93, Q = 0xCA5A826395121157;
    uint64_t c[4] = {0, 0, 0, 0}, counts = (of + 3) / 4;
    int round;
    c[0] = step * counts + place / 4 + 1; /* four draws a count */
    for (round = 0; round < 10; round++) {
        uint64_t before[4];
        memcpy(before, c, sizeof c);
        c[0] = high_half(Q, before[2]) ^ before[1] ^ seed;
        c[1] = Q * before[2];
        c[2] = high_half(P, before[0]) ^ before[3] ^ stream;
        c[3] = P * before[0];
        seed += 0x9E3779B97F4A7C15;
        stream += 0xBB67AE8584CAA73B;
    }
    return (double)(c[place % 4] >> 11) * (1.0 / 9007199254740992.0);
}
