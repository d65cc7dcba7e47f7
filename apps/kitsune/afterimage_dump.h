/* The statistics of `afterimage.c` as bytes, and back; features go on bit-equal.  See `state_dump.h`. */

#ifndef AFTERIMAGE_DUMP_H
#define AFTERIMAGE_DUMP_H

#include "state_dump.h"

#define MOST_LOGGED (1u << 26)
#define LARGEST 1e60 /* more than traffic can sum up to, and its fourth power is a number */
#define LEAST_SPREAD 1e-12 /* of lengths, if they differ: rounding alone makes it larger */

/* ---- numbered cells */

/* The room for what a dump holds; the pool is a fresh one.  `seen` marks the cells that were met. */
static void pool_make(Dump *dump, Pool *pool, int32_t used, uint8_t **seen)
{
    dump_check(dump, !pool->limit || used <= pool->limit);
    *seen = NULL;
    if (dump->failed)
        return;
    pool->room = used;
    pool->cells = calloc((size_t)used + 1, pool->cell_size);
    pool->slot = calloc((size_t)used + 1, sizeof *pool->slot);
    *seen = calloc((size_t)used + 1, 1);
    if (!pool->cells || !pool->slot || !*seen) {
        dump->failed = NO_MEMORY;
        return;
    }
    pool->used = used;
}

/* As many buckets as `pool_spread` would have made. */
static void pool_widen(Dump *dump, Pool *pool, int32_t live)
{
    uint32_t mask = pool->mask;
    while ((uint32_t)live > mask)
        mask = mask * 4 + 3;
    int32_t *bucket = malloc(((size_t)mask + 1) * sizeof *bucket);
    if (!bucket) {
        dump->failed = NO_MEMORY;
        return;
    }
    memset(bucket, 0xFF, ((size_t)mask + 1) * sizeof *bucket);
    free(pool->bucket);
    pool->bucket = bucket;
    pool->mask = mask;
}

/* A cell that no list has named before. */
static int32_t fresh_cell(Dump *dump, int32_t at, int32_t used, uint8_t *seen)
{
    DUMP(dump, at);
    dump_check(dump, at >= 0 && at < used && !(dump->in && seen[at]));
    if (dump->failed)
        return NONE;
    if (dump->in)
        seen[at] = 1;
    return at;
}

typedef struct Loading {
    AfterImage *self;
    Table *table;
} Loading;

typedef uint32_t (*DumpCell)(Dump *, Loading *, int32_t at);
/* Dumps one cell; returns its hash. */

static void dump_pool(Dump *dump, Loading *loading, Pool *pool, DumpCell cell)
{
    int32_t used = pool->used, live = pool->live;
    uint8_t *seen = NULL;
    dump_cells(dump, &used, &live);
    if (dump->in) {
        pool_make(dump, pool, used, &seen);
        if (!dump->failed)
            pool_widen(dump, pool, live);
        loading->table->stream = loading->table->streams.cells;
        loading->table->link = loading->table->links.cells;
    }
    int32_t each = pool->oldest;
    for (int32_t n = 0; n < live && !dump->failed; n++) {
        int32_t at = fresh_cell(dump, each, used, seen);
        if (at == NONE)
            break;
        uint32_t hash = cell(dump, loading, at);
        if (dump->in && !dump->failed) {
            pool->slot[at].hash = hash;
            attach(pool, at);
            chain(pool, at);
            pool->live++;
        } else if (!dump->in)
            each = pool->slot[at].newer;
    }
    int32_t *end = &pool->free;
    each = pool->free;
    for (int32_t n = live; n < used && !dump->failed; n++) {
        int32_t at = fresh_cell(dump, each, used, seen);
        if (at == NONE)
            break;
        if (dump->in) {
            *end = at;
            end = &pool->slot[at].next;
            *end = NONE;
        } else
            each = pool->slot[at].next;
    }
    free(seen);
}

/* Those of a structure that lie in a row. */
#define NUMBERS(cell, first, after) (const double *)((const char *)(cell) + (first)), ((after) - (first)) / sizeof(double)

/* Statistics that are read are numbers from which features can be computed. */
static void check_numbers(Dump *dump, const double *numbers, size_t count, double least)
{
    for (size_t i = 0; dump->in && i < count; i++)
        dump_check(dump, numbers[i] >= least && numbers[i] <= LARGEST);
}

/* ---- streams */

static void check_event(Dump *dump, const Event *event)
{
    check_numbers(dump, &event->time, 1, -LARGEST);
    check_numbers(dump, &event->since, 1, -LARGEST);
    check_numbers(dump, event->residual, SCALES, -LARGEST);
    for (int k = 0; dump->in && event->since > 0 && k < SCALES; k++)
        dump_check(dump, event->factor[k] >= 0 && event->factor[k] <= 1);
}

static void dump_log(Dump *dump, Loading *loading, int32_t at)
{
    const AfterImage *self = loading->self;
    Table *table = loading->table;
    Stream *s = &table->stream[at];
    uint64_t logged_so_far = s->logged, room = s->log_room;
    DUMP(dump, logged_so_far);
    DUMP(dump, room);
    if (dump->failed)
        return;
    uint64_t kept = logged_so_far < room ? logged_so_far : room;
    if (dump->in) {
        int power = !(room & (room - 1)), enough = logged_so_far <= room || (self->bounded && room == LOG_KEPT);
        dump_check(dump, (!room && !logged_so_far) || (room >= 16 && room <= MOST_LOGGED && power && enough && logged_so_far));
        dump_check(dump, !self->bounded || room <= LOG_KEPT);
        dump_check(dump, room <= 16 || logged_so_far > room / 2);
        dump_check(dump, logged_so_far < UINT64_MAX / 2 && kept <= (dump->size - dump->at) / offsetof(Event, zero));
        dump_check(dump, !self->bounded || !room || table->logs < table->most_logs);
        if (dump->failed || !room)
            return;
        if (!(s->log = calloc(room, sizeof *s->log))) {
            dump->failed = NO_MEMORY;
            return;
        }
        s->log_room = room;
        s->logged = logged_so_far;
        if (self->bounded)
            table->logging[table->logs++] = at;
    }
    for (uint64_t number = logged_so_far - kept; number < logged_so_far && !dump->failed; number++) {
        dump_bytes(dump, logged(s, number), offsetof(Event, zero));
        check_event(dump, logged(s, number));
    }
}

static uint32_t dump_stream(Dump *dump, Loading *loading, int32_t at)
{
    Stream *s = &loading->table->stream[at];
    dump_bytes(dump, &s->key, sizeof s->key);
    dump_bytes(dump, &s->last, offsetof(Stream, first_link) - offsetof(Stream, last));
    DUMP(dump, s->hub);
    if (dump->in) {
        s->first_link = s->last_link = s->first_hub_link = s->self_link = NONE;
        dump_check(dump, s->key.length < KEY_BYTES && (s->hub == 0 || s->hub == 1));
        check_numbers(dump, NUMBERS(s, offsetof(Stream, last), offsetof(Stream, packets)), -LARGEST);
        check_numbers(dump, s->w, SCALES, 0);
        check_numbers(dump, s->count, SCALES, 0);
        int64_t which = loading->table - loading->self->table;
        for (int k = 0; (which == HOSTS || which == SOCKETS) && k < SCALES; k++) /* correlations are divided by it */
            dump_check(dump, !s->std[k] || s->std[k] >= LEAST_SPREAD);
    }
    dump_log(dump, loading, at);
    dump_check(dump, s->hub || !s->logged);
    return dump->failed ? 0 : hash_key(&s->key);
}

/* ---- links */

static int is_live(const uint8_t *live, const Pool *pool, int32_t at)
{
    return at >= 0 && at < pool->used && live[at];
}

static uint32_t dump_link(Dump *dump, Loading *loading, int32_t at)
{
    Table *table = loading->table;
    Link *link = &table->link[at];
    DUMP(dump, link->end);
    dump_bytes(dump, &link->last, offsetof(Link, next) - offsetof(Link, last));
    dump_bytes(dump, link->seen, sizeof *link - offsetof(Link, seen));
    if (dump->failed)
        return 0;
    if (dump->in) {
        check_numbers(dump, NUMBERS(link, offsetof(Link, last), offsetof(Link, next)), -LARGEST);
        check_numbers(dump, NUMBERS(link, offsetof(Link, then), sizeof *link), -LARGEST);
        check_numbers(dump, link->w3, SCALES, 0);
        check_numbers(dump, NUMBERS(link, offsetof(Link, count_then), offsetof(Link, residuals_then)), 0);
        for (int side = 0; side < 2; side++) {
            int32_t end = link->end[side];
            dump_check(dump, end >= 0 && end < table->streams.used);
            if (dump->failed)
                return 0;
            dump_check(dump, link->seen[side] <= table->stream[end].logged);
        }
        dump_check(dump, find_link(table, link->end[0], link->end[1]) == NONE);
    }
    return hash_pair(link->end[0], link->end[1]);
}

/* The links of each stream in their order, then those to hubs in theirs. */
static void dump_lists(Dump *dump, Table *table, uint8_t *listed)
{
    for (int32_t at = table->streams.oldest; at != NONE && !dump->failed; at = table->streams.slot[at].newer) {
        Stream *s = &table->stream[at];
        int32_t degree = dump_number(dump, s->degree, table->links.used), i = s->first_link;
        for (int32_t n = 0; n < degree && !dump->failed; n++) {
            DUMP(dump, i);
            dump_check(dump, i >= 0 && i < table->links.used);
            if (dump->failed)
                return;
            Link *link = &table->link[i];
            int side = side_of(link, at);
            if (!dump->in) {
                i = link->next[side];
                continue;
            }
            /* bits: listed at end 0, at end 1, is live */
            dump_check(dump, listed[i] & 4 && link->end[side] == at && !(listed[i] & 1 << side));
            if (dump->failed)
                return;
            listed[i] |= (uint8_t)(1 << side);
            join_list(table, i, side);
            if (link->end[0] == link->end[1])
                s->self_link = i;
        }
    }
}

static void dump_hub_lists(Dump *dump, Table *table, uint8_t *listed)
{
    for (int32_t at = table->streams.oldest; at != NONE && !dump->failed; at = table->streams.slot[at].newer) {
        Stream *s = &table->stream[at];
        int32_t count = dump_number(dump, s->hub_links, s->degree), last = NONE, i = s->first_hub_link;
        for (int32_t n = 0; n < count && !dump->failed; n++) {
            DUMP(dump, i);
            dump_check(dump, i >= 0 && i < table->links.used);
            if (dump->failed)
                return;
            Link *link = &table->link[i];
            int side = side_of(link, at);
            if (!dump->in) {
                i = link->next_hub[side];
                continue;
            }
            dump_check(dump, listed[i] & 4 && link->end[side] == at && link->end[!side] != at && table->stream[link->end[!side]].hub
                                 && !(listed[i] & 8 << side));
            if (dump->failed)
                return;
            listed[i] |= (uint8_t)(8 << side);
            link->previous_hub[side] = last;
            link->next_hub[side] = NONE;
            *(last == NONE ? &s->first_hub_link : &table->link[last].next_hub[side_of(&table->link[last], at)]) = i;
            last = i;
            s->hub_links++;
        }
    }
}

/* Every link is in the lists of its ends, and in those of hubs where an end is one. */
static void check_lists(Dump *dump, const Table *table, const uint8_t *listed)
{
    for (int32_t i = table->links.oldest; i != NONE && !dump->failed; i = table->links.slot[i].newer) {
        const Link *link = &table->link[i];
        int a = table->stream[link->end[0]].hub, b = table->stream[link->end[1]].hub;
        int self = link->end[0] == link->end[1];
        dump_check(dump, listed[i] == (self ? 4 | 1 : 4 | 1 | 2 | (b ? 8 : 0) | (a ? 16 : 0)));
    }
}

static void dump_neighbours(Dump *dump, Table *table)
{
    uint8_t *listed = NULL;
    if (dump->in) {
        if (!(listed = calloc((size_t)table->links.used + 1, 1))) {
            dump->failed = NO_MEMORY;
            return;
        }
        for (int32_t i = table->links.oldest; i != NONE; i = table->links.slot[i].newer)
            listed[i] = 4;
    }
    dump_lists(dump, table, listed);
    dump_hub_lists(dump, table, listed);
    if (dump->in && !dump->failed)
        check_lists(dump, table, listed);
    free(listed);
}

/* ---- what the replay of logs relies on */

static int by_number(const void *a, const void *b)
{
    uint64_t one = *(const uint64_t *)a, other = *(const uint64_t *)b;
    return (one > other) - (one < other);
}

/* No two packets of a table have the same number: whoever replays them one by one comes to an end. */
static void check_orders(Dump *dump, const Table *table)
{
    size_t count = 0, n = 0;
    for (int32_t at = table->streams.oldest; at != NONE; at = table->streams.slot[at].newer) {
        const Stream *s = &table->stream[at];
        count += s->logged < s->log_room ? s->logged : s->log_room;
    }
    uint64_t *orders = count ? malloc(count * sizeof *orders) : NULL;
    if (!count)
        return;
    if (!orders) {
        dump->failed = NO_MEMORY;
        return;
    }
    for (int32_t at = table->streams.oldest; at != NONE; at = table->streams.slot[at].newer) {
        const Stream *s = &table->stream[at];
        for (uint64_t number = s->logged - (s->logged < s->log_room ? s->logged : s->log_room); number < s->logged; number++)
            orders[n++] = logged(s, number)->order;
    }
    qsort(orders, count, sizeof *orders, by_number);
    for (size_t i = 1; i < count; i++)
        dump_check(dump, orders[i] != orders[i - 1]);
    dump_check(dump, orders[count - 1] != UINT64_MAX);
    free(orders);
}

static void check_ends(Dump *dump, const Table *table)
{
    uint8_t *live = calloc((size_t)table->streams.used + 1, 1);
    if (!live) {
        dump->failed = NO_MEMORY;
        return;
    }
    for (int32_t at = table->streams.oldest; at != NONE; at = table->streams.slot[at].newer)
        live[at] = 1;
    for (int32_t i = table->links.oldest; i != NONE; i = table->links.slot[i].newer)
        for (int side = 0; side < 2; side++)
            dump_check(dump, is_live(live, &table->streams, table->link[i].end[side]));
    free(live);
}

static void dump_tables(Dump *dump, AfterImage *self)
{
    for (int i = 0; i < 4 && !dump->failed; i++) {
        Table *table = &self->table[i];
        Loading loading = {self, table};
        dump_pool(dump, &loading, &table->streams, dump_stream);
        dump_pool(dump, &loading, &table->links, dump_link);
        if (dump->in && !dump->failed)
            check_ends(dump, table);
        if (!dump->failed)
            dump_neighbours(dump, table);
        if (dump->in && !dump->failed)
            check_orders(dump, table);
    }
}

static int dump_afterimage(Dump *dump, AfterImage *self)
{
    int64_t horizon;
    memcpy(&horizon, &self->horizon, sizeof horizon);
    const int64_t layout[] = {sizeof(Stream), sizeof(Link), sizeof(Event), SCALES, KEY_BYTES, self->bounded, horizon,
                              self->table[0].streams.limit, self->table[0].links.limit};
    for (size_t i = 0; i < sizeof layout / sizeof *layout; i++)
        dump_same(dump, layout[i]);
    DUMP(dump, self->order);
    DUMP(dump, self->evicted_idle);
    DUMP(dump, self->evicted_full);
    DUMP(dump, self->clock);
    DUMP(dump, self->offset);
    dump_check(dump, self->order < UINT64_MAX / 2);
    check_numbers(dump, &self->clock, 1, -HUGE_VAL); /* before the first packet */
    check_numbers(dump, &self->offset, 1, -LARGEST);
    dump_tables(dump, self);
    return dump_end(dump);
}

/* The size of the dump; it is written where there is room for it. */
long afterimage_dump(AfterImage *self, uint8_t *out, long room)
{
    Dump dump = dump_to(out, room);
    return dump_afterimage(&dump, self) ? -1 : (long)dump.at;
}

/* Into fresh statistics; those are of no use where this fails. */
int afterimage_load(AfterImage *self, const uint8_t *in, long size)
{
    Dump dump = dump_from(in, size);
    return self->order || self->failed ? NOT_A_STATE : dump_afterimage(&dump, self);
}

#endif
