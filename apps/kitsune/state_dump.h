/* Dumps of a tracker or of the statistics: the same code measures, writes and reads, so that what is read is what was
 * written.
 *
 * A dump holds no pointers and no hashes: what finds an entry is made anew when it is read, and every number that is
 * used as an index is checked.  Numbers are those of a 64-bit machine with little-endian bytes; the head says which
 * layout they have.
 */

#ifndef STATE_DUMP_H
#define STATE_DUMP_H

#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define NOT_A_STATE (-2)
#define NO_MEMORY (-1)
#define MOST_CELLS (1 << 24) /* of one table */

typedef struct {
    uint8_t *out;      /* NULL while measuring and reading */
    const uint8_t *in; /* NULL while measuring and writing */
    size_t at, size;
    int failed; /* 0, NO_MEMORY or NOT_A_STATE */
} Dump;

#define DUMP(dump, value) dump_bytes(dump, &(value), sizeof(value))

static inline void dump_bytes(Dump *dump, void *bytes, size_t count)
{
    if (dump->failed)
        return;
    if ((dump->in || dump->out) && count > dump->size - dump->at) {
        dump->failed = NOT_A_STATE;
        return;
    }
    if (dump->in)
        memcpy(bytes, dump->in + dump->at, count);
    else if (dump->out)
        memcpy(dump->out + dump->at, bytes, count);
    dump->at += count;
}

static inline void dump_check(Dump *dump, int holds)
{
    if (!holds && !dump->failed)
        dump->failed = NOT_A_STATE;
}

/* A number from 0 to `most`; 0 where that fails. */
static inline int32_t dump_number(Dump *dump, int32_t number, int32_t most)
{
    DUMP(dump, number);
    dump_check(dump, number >= 0 && number <= most);
    return dump->failed ? 0 : number;
}

/* What must be the same here as where the dump was made. */
static inline void dump_same(Dump *dump, int64_t here)
{
    int64_t number = here;
    DUMP(dump, number);
    dump_check(dump, number == here);
}

/* How many cells a table uses and how many of them are live; each takes four bytes at least. */
static inline void dump_cells(Dump *dump, int32_t *used, int32_t *live)
{
    *used = dump_number(dump, *used, MOST_CELLS);
    *live = dump_number(dump, *live, *used);
    if (dump->in)
        dump_check(dump, (size_t)*used * sizeof(int32_t) <= dump->size - dump->at);
    if (dump->failed)
        *used = *live = 0;
}

/* The end of a dump that is read: nothing is left. */
static inline int dump_end(Dump *dump)
{
    if (dump->in)
        dump_check(dump, dump->at == dump->size);
    return dump->failed;
}

static inline Dump dump_to(uint8_t *out, long room)
{
    Dump dump = {out, NULL, 0, room > 0 ? (size_t)room : 0, 0};
    return dump;
}

static inline Dump dump_from(const uint8_t *in, long size)
{
    static const uint8_t NOTHING[1];
    Dump dump = {NULL, in && size > 0 ? in : NOTHING, 0, in && size > 0 ? (size_t)size : 0, 0};
    return dump;
}

#endif
