/* What `behaviour.c` knows as bytes, and back.  See `state_dump.h`.
 *
 * Blocks are no part of it: whoever reads a dump has them from elsewhere.
 */

#ifndef BEHAVIOUR_DUMP_H
#define BEHAVIOUR_DUMP_H

#include "table_dump.h"

#define MOST_DUMPED_EVENTS (2 * MOST_EVENTS)
#define LARGEST_COUNT 1e15 /* more than seconds, nats and counts of packets ever are */

/* Seconds, nats and counts that are read are numbers, of which messages can tell. */
static void check_count(Dump *dump, double number)
{
    if (dump->in)
        dump_check(dump, number >= -LARGEST_COUNT && number <= LARGEST_COUNT);
}

/* As `check_count`; what has not happened yet was endlessly long ago. */
static void check_past(Dump *dump, double number)
{
    if (number != -INFINITY)
        check_count(dump, number);
}

/* A payload of doubles; `context` is its table. */
static void dump_counts(Dump *dump, void *context, void *of)
{
    size_t bytes = ((const Table *)context)->stride - sizeof(Head);
    const double *numbers = of;
    dump_bytes(dump, of, bytes);
    for (size_t i = 0; i < bytes / sizeof *numbers; i++)
        check_past(dump, numbers[i]);
}

static void dump_visit(Dump *dump, void *context, void *of)
{
    (void)context;
    dump_bytes(dump, of, sizeof(Visit));
    check_count(dump, ((const Visit *)of)->time);
}

/* ---- events of a subject */

static void make_events(Dump *dump, Events *events, int32_t count)
{
    int32_t room = NEAR_EVENTS;
    if (count > NEAR_EVENTS) {
        for (room = 8; room < count;)
            room *= 2;
        if (!(events->far = calloc(2 * (size_t)room + 1, sizeof *events->far))) {
            dump->failed = NO_MEMORY;
            return;
        }
    }
    events->count = count;
    events->room = room;
}

static void dump_events(Dump *dump, void *context, void *of)
{
    Events *events = of;
    const Counter *counter = context;
    int32_t count = dump_number(dump, events->count, MOST_DUMPED_EVENTS);
    if (dump->in && !dump->failed)
        make_events(dump, events, count);
    DUMP(dump, events->first);
    events->unordered = dump_number(dump, events->unordered, 1);
    if (dump->failed)
        return;
    for (int i = 0; i < counter->set.windows; i++)
        dump_check(dump, events->first[i] >= 0 && events->first[i] <= count);
    dump_bytes(dump, times_of(events), (size_t)count * sizeof(double));
    dump_bytes(dump, times_of(events) + events->room, ((size_t)count + 1) * sizeof(double));
    for (int32_t i = 0; i < count; i++)
        check_count(dump, times_of(events)[i]);
    for (int32_t i = 0; i <= count; i++)
        check_count(dump, times_of(events)[events->room + i]);
}

static void dump_counter(Dump *dump, Counter *counter)
{
    counter->usable = dump_number(dump, counter->usable, counter->set.windows);
    dump_check(dump, counter->usable >= 1);
    DUMP(dump, counter->own_scale);
    DUMP(dump, counter->shared_scale);
    DUMP(dump, counter->rarity);
    DUMP(dump, counter->begun);
    const double numbers[] = {counter->own_scale, counter->shared_scale, counter->rarity};
    for (size_t i = 0; i < sizeof numbers / sizeof *numbers; i++)
        check_count(dump, numbers[i]);
    for (int i = 0; i < MOST_WINDOWS; i++)
        check_count(dump, counter->begun[i]);
    dump_table(dump, &counter->events, dump_events, counter);
    Table *counts[] = {&counter->shared, &counter->highest, &counter->reported};
    for (size_t i = 0; i < sizeof counts / sizeof *counts; i++)
        dump_table(dump, counts[i], dump_counts, counts[i]);
    if (dump->in) {
        counter->quiet = NONE;
        counter->is_shared_known = 0;
    }
}

/* ---- contacts */

static void dump_pending(Dump *dump, void *context, void *of)
{
    (void)context;
    dump_bytes(dump, of, offsetof(Pending, known) + sizeof(int32_t)); /* without what pads it */
    check_count(dump, ((const Pending *)of)->time);
}

static void dump_dues(Dump *dump, const Behaviour *b, Dues *dues)
{
    int32_t count = dump_number(dump, (int32_t)dues->count, MOST_CELLS);
    if (dump->in) {
        dump_check(dump, (size_t)count <= (dump->size - dump->at) / sizeof(Subject));
        int64_t room = 1024;
        while (room < count)
            room *= 2;
        if (!dump->failed && !(dues->due = calloc((size_t)room, sizeof *dues->due)))
            dump->failed = NO_MEMORY;
        if (dump->failed)
            return;
        dues->room = room;
        dues->count = count;
    }
    for (int32_t i = 0; i < count && !dump->failed; i++) {
        Due *due = &dues->due[(dues->from + i) & (dues->room - 1)];
        DUMP(dump, due->deadline);
        check_count(dump, due->deadline);
        DUMP(dump, due->contact.subject);
        if (dump->in)
            due->contact = keyed_by(b, due->contact.subject);
    }
}

static void dump_tail(Dump *dump, Behaviour *b)
{
    int32_t count = dump_number(dump, (int32_t)b->tail_count, b->limits.calibration);
    for (int32_t i = 0; i < count && !dump->failed; i++) {
        Trained *each = &b->tail[(b->tail_from + i) % b->limits.calibration];
        DUMP(dump, *each);
        check_count(dump, each->time);
    }
    if (dump->in)
        b->tail_count = count;
}

static void dump_numbers(Dump *dump, Behaviour *b)
{
    DUMP(dump, b->callback_nats);
    DUMP(dump, b->callback_usual);
    DUMP(dump, b->arp_grace);
    DUMP(dump, b->slowest_arp);
    DUMP(dump, b->arp_replies);
    DUMP(dump, b->generation);
    DUMP(dump, b->young);
    DUMP(dump, b->exchange_halves);
    DUMP(dump, b->packets);
    DUMP(dump, b->per_block);
    DUMP(dump, b->begun);
    DUMP(dump, b->seconds);
    DUMP(dump, b->one_way_most);
    DUMP(dump, b->outside_last);
    DUMP(dump, b->outside_gap);
    DUMP(dump, b->silence);
    DUMP(dump, b->in_vain_since);
    const double numbers[] = {b->callback_nats, b->callback_usual, b->arp_grace, b->slowest_arp, b->begun, b->seconds, b->outside_last,
                              b->outside_gap, b->silence, b->in_vain_since};
    for (size_t i = 0; i < sizeof numbers / sizeof *numbers; i++)
        check_past(dump, numbers[i]);
    for (size_t i = 0; i < sizeof b->one_way_most / sizeof *b->one_way_most; i++)
        for (int block = 0; block < MOST_BLOCKS; block++)
            check_past(dump, b->one_way_most[i][block]);
    b->outside_heard = dump_number(dump, b->outside_heard, 1);
    b->outside_reached = dump_number(dump, b->outside_reached, 1);
    b->learning = dump_number(dump, b->learning, 1);
    dump_check(dump, b->packets >= 0 && b->per_block >= 1 && b->exchange_halves >= 0 && b->young >= 0 && b->generation >= 1);
    dump_check(dump, b->packets < INT64_MAX / 2 && b->exchange_halves < INT64_MAX / 2 && b->young < INT64_MAX / 2);
}

/* ---- what entries say of each other */

static int is_sender(const Subject *sender, int32_t switches)
{
    const uint64_t *word = sender->word;
    return (int32_t)(word[1] & 0xFFFF) < switches && is_address(word[1] >> 16 & 1 ? 6 : 4, word[2], word[3]);
}

static void check_pending(Dump *dump, Behaviour *b, int32_t switches)
{
    b->orphans = 0;
    for (int32_t at = b->pending.oldest; at != NONE; at = head(&b->pending, at)->newer) {
        const Pending *pending = payload(&b->pending, at);
        const uint64_t *word = head(&b->pending, at)->key.word;
        uint64_t version = word[1] ? 6 : 4;
        int is_known = pending->known != NONE;
        b->orphans += !is_known;
        dump_check(dump, !is_known || (is_entry(&b->known, pending->known) && ((const Known *)payload(&b->known, pending->known))->pending == at));
        dump_check(dump, word[0] >> 32 == 0 && is_address(version, word[2], word[3]) && is_address(version, word[4], word[5]));
        dump_check(dump, is_sender(&pending->sender, switches));
    }
}

static void check_known(Dump *dump, const Behaviour *b)
{
    for (int32_t at = b->known.oldest; at != NONE; at = head(&b->known, at)->newer) {
        int32_t pending = ((const Known *)payload(&b->known, at))->pending;
        const uint64_t *word = head(&b->known, at)->key.word;
        uint64_t version = word[1] ? 6 : 4;
        dump_check(dump, pending == NONE || (is_entry(&b->pending, pending) && ((const Pending *)payload(&b->pending, pending))->known == at));
        dump_check(dump, word[0] >> 32 == 0 && is_address(version, word[2], word[3]) && is_address(version, word[4], word[5]));
    }
}

static void check_senders(Dump *dump, const Behaviour *b, int32_t switches)
{
    for (int32_t at = b->visits.oldest; at != NONE; at = head(&b->visits, at)->newer)
        dump_check(dump, is_sender(&((const Visit *)payload(&b->visits, at))->sender, switches));
    for (int32_t at = b->logins.oldest; at != NONE; at = head(&b->logins, at)->newer)
        dump_check(dump, is_sender(&((const Login *)payload(&b->logins, at))->sender, switches));
    for (int64_t i = 0; i < b->tail_count; i++)
        dump_check(dump, is_sender(&b->tail[i].sender, switches));
    for (int32_t at = b->owner_macs.oldest; at != NONE; at = head(&b->owner_macs, at)->newer)
        dump_check(dump, is_entry(&b->owners, *(const int32_t *)payload(&b->owner_macs, at)));
}

static int dump_behaviour(Dump *dump, Behaviour *b, int32_t switches)
{
    const struct {
        Table *table;
        DumpPayload each;
    } parts[] = {{&b->failures, dump_counts}, {&b->called, dump_counts}, {&b->visits, dump_visit}, {&b->vain, NULL}, {&b->proven, NULL},
                 {&b->senders, NULL}, {&b->owners, dump_counts}, {&b->owner_macs, NULL}, {&b->exchanges, NULL}, {&b->asked, dump_counts},
                 {&b->logins, NULL}, {&b->strangers, NULL}, {&b->told, dump_counts}, {&b->in_vain, NULL}, {&b->known, NULL}};
    dump_same(dump, b->limits.calibration);
    dump_same(dump, b->limits.blocks);
    for (int what = 0; what < STATISTICS && !dump->failed; what++) {
        dump_same(dump, b->counter[what].set.windows);
        dump_counter(dump, &b->counter[what]);
    }
    for (size_t i = 0; i < sizeof parts / sizeof *parts; i++)
        dump_table(dump, parts[i].table, parts[i].each, parts[i].table);
    dump_table(dump, &b->pending, dump_pending, NULL);
    for (int which = 0; which < 2; which++)
        dump_dues(dump, b, &b->dues[which]);
    dump_tail(dump, b);
    dump_numbers(dump, b);
    if (dump->in && !dump->failed) {
        check_pending(dump, b, switches);
        check_known(dump, b);
        check_senders(dump, b, switches);
    }
    return dump_end(dump);
}

/* The size of the dump; it is written where there is room for it. */
long behaviour_dump(Behaviour *b, uint8_t *out, long room)
{
    Dump dump = dump_to(out, room);
    return dump_behaviour(&dump, b, 0) ? -1 : (long)dump.at;
}

/* Into a fresh tracker, which is of no use where this fails; senders are those of so many switches. */
int behaviour_load(Behaviour *b, const uint8_t *in, long size, int32_t switches)
{
    Dump dump = dump_from(in, size);
    return dump_behaviour(&dump, b, switches);
}

#endif
