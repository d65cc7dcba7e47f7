/* What `victims.c` has counted as bytes, and back.  See `state_dump.h`. */

#ifndef VICTIMS_DUMP_H
#define VICTIMS_DUMP_H

#include "table_dump.h"

static void check_victims(Dump *dump, const Table *table)
{
    for (int32_t at = table->oldest; at != NONE; at = head(table, at)->newer) {
        const uint64_t *word = head(table, at)->key.word;
        dump_check(dump, word[1] <= 1 && is_address(word[1] ? 6 : 4, word[2], word[3]));
        dump_check(dump, word[0] >> 32 == 0 && is_address(word[1] ? 6 : 4, word[4], word[5]));
    }
}

static int dump_victims(Dump *dump, Victims *v)
{
    Table *tables[] = {&v->now, &v->last, &v->usual, &v->sources};
    for (size_t i = 0; i < sizeof tables / sizeof *tables; i++)
        dump_table(dump, tables[i], NULL, NULL);
    DUMP(dump, v->second);
    DUMP(dump, v->named);
    dump_check(dump, v->named >= 0);
    for (size_t i = 0; dump->in && !dump->failed && i < sizeof tables / sizeof *tables; i++)
        check_victims(dump, tables[i]);
    return dump_end(dump);
}

/* The size of the dump; it is written where there is room for it. */
long victims_dump(Victims *v, uint8_t *out, long room)
{
    Dump dump = dump_to(out, room);
    return dump_victims(&dump, v) ? -1 : (long)dump.at;
}

/* Into a fresh tracker, which is of no use where this fails. */
int victims_load(Victims *v, const uint8_t *in, long size)
{
    Dump dump = dump_from(in, size);
    return dump_victims(&dump, v);
}

#endif
