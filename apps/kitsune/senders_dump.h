/* The senders, seconds and conversations of `senders.c` as bytes, and back.  See `state_dump.h`.
 *
 * Blocks are no part of it: whoever reads a dump has them from elsewhere.
 */

#ifndef SENDERS_DUMP_H
#define SENDERS_DUMP_H

#include "table_dump.h"

static void dump_tally(Dump *dump, Tally *tally)
{
    uint8_t version = tally->last_destination.version;
    dump_bytes(dump, tally, offsetof(Tally, kept_at) + sizeof tally->kept_at);
    dump_bytes(dump, &tally->packets, offsetof(Tally, last_destination) - offsetof(Tally, packets));
    DUMP(dump, tally->last_destination.hi);
    DUMP(dump, tally->last_destination.lo);
    DUMP(dump, version);
    DUMP(dump, tally->has_destination);
    if (dump->in)
        tally->last_destination.version = version;
}

static void dump_tallies(Dump *dump, Senders *s)
{
    int32_t count = dump_number(dump, s->tally_count, MOST_CELLS);
    if (dump->in) {
        dump_check(dump, (size_t)count <= (dump->size - dump->at) / sizeof(int64_t));
        if (dump->failed)
            return;
        s->tallies = calloc((size_t)count + 1, sizeof *s->tallies);
        if (!s->tallies) {
            dump->failed = NO_MEMORY;
            return;
        }
        s->tally_room = count + 1;
        s->tally_count = count;
    }
    for (int32_t i = 0; i < count && !dump->failed; i++)
        dump_tally(dump, &s->tallies[i]);
}

static int knows_sender(const Senders *s, int32_t number)
{
    return number >= 0 && number < s->records.used;
}

static void check_records(Dump *dump, const Senders *s, int32_t switches)
{
    for (int32_t at = s->records.oldest; at != NONE; at = head(&s->records, at)->newer) {
        const uint64_t *word = head(&s->records, at)->key.word;
        const Record *record = payload(&s->records, at);
        dump_check(dump, (int32_t)(word[1] & 0xFFFF) < switches && word[1] >> 24 == 0);
        dump_check(dump, is_address(word[1] >> 16 & 0xFF, word[2], word[3]));
        dump_check(dump, record->serial < s->serial || (record->serial == s->serial && record->tally >= 0 && record->tally < s->tally_count));
    }
}

static void check_conversations(Dump *dump, const Senders *s)
{
    const Table *tables[] = {&s->young, &s->old};
    for (int which = 0; which < 2; which++)
        for (int32_t at = tables[which]->oldest; at != NONE; at = head(tables[which], at)->newer)
            dump_check(dump, knows_sender(s, ((const Conversation *)payload(tables[which], at))->sender));
}

static void check_speakers(Dump *dump, const Senders *s)
{
    for (int32_t at = s->speakers.oldest; at != NONE; at = head(&s->speakers, at)->newer) {
        const uint64_t *word = head(&s->speakers, at)->key.word;
        dump_check(dump, word[0] <= 6 && is_address(word[0], word[2], word[3]));
    }
}

/* What a second needs when it closes: a sender, and where its packet with the highest score is explained. */
static void check_tallies(Dump *dump, const Senders *s)
{
    for (int32_t i = 0; i < s->tally_count; i++) {
        const Tally *tally = &s->tallies[i];
        dump_check(dump, knows_sender(s, tally->sender));
        dump_check(dump, tally->kept_in >= NONE && tally->kept_in <= s->batch && tally->kept_at >= 0);
        dump_check(dump, tally->over <= 0 || tally->kept_in != NONE);
    }
}

static int dump_senders(Dump *dump, Senders *s, int32_t switches)
{
    Table *tables[] = {&s->records, &s->destinations, &s->young, &s->old, &s->towards, &s->speakers};
    for (size_t i = 0; i < sizeof tables / sizeof *tables; i++)
        dump_table(dump, tables[i], NULL, NULL);
    DUMP(dump, s->serial);
    DUMP(dump, s->second);
    DUMP(dump, s->turned);
    s->has_second = dump_number(dump, s->has_second, 1);
    s->training = dump_number(dump, s->training, 1);
    s->batch = dump_number(dump, s->batch, INT32_MAX);
    dump_check(dump, s->serial >= 0);
    dump_same(dump, (int64_t)sizeof(Tally));
    dump_tallies(dump, s);
    if (dump->in && !dump->failed) {
        check_records(dump, s, switches);
        check_conversations(dump, s);
        check_speakers(dump, s);
        check_tallies(dump, s);
    }
    return dump_end(dump);
}

/* The size of the dump; it is written where there is room for it. */
long senders_dump(Senders *s, uint8_t *out, long room)
{
    Dump dump = dump_to(out, room);
    return dump_senders(&dump, s, 0) ? -1 : (long)dump.at;
}

/* Into a fresh tracker, which is of no use where this fails; senders are those of so many switches. */
int senders_load(Senders *s, const uint8_t *in, long size, int32_t switches)
{
    Dump dump = dump_from(in, size);
    return dump_senders(&dump, s, switches);
}

/* Of the open second, what is kept for Python: pairs of batch and place; returns how many. */
long senders_kept(const Senders *s, int32_t *out, long room)
{
    long count = 0;
    for (int32_t i = 0; i < s->tally_count; i++) {
        if (s->tallies[i].kept_in == NONE)
            continue;
        if (count < room) {
            out[2 * count] = s->tallies[i].kept_in;
            out[2 * count + 1] = s->tallies[i].kept_at;
        }
        count++;
    }
    return count;
}

#endif
