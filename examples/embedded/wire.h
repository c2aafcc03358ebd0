/* What every node needs to speak in a run of peakmesh, whatever carries it: numbers in JSON, digests, losses of the model.
   docs/protocol.md says what they are for. */
#ifndef WIRE_H
#define WIRE_H

#include <stddef.h>
#include <stdint.h>

enum { WIRE_NUMBER = 26 }; /* characters of a number at most, and the zero after them */

/* The shortest decimal that reads back as the same double, laid out as the other nodes do it; how many characters. */
size_t wire_number(char text[WIRE_NUMBER], double value);

/* BLAKE2b without a key, RFC 7693: a digest of `size` bytes, at most 64. */
void wire_digest(uint8_t *digest, size_t size, const void *data, size_t length);

/* Draw `place` of the `of` that belong to a step of stream `stream`, in [0, 1): Philox 4x64-10, key (seed, stream). */
double wire_draw(uint64_t seed, uint64_t stream, uint64_t step, unsigned of, unsigned place);

#endif
