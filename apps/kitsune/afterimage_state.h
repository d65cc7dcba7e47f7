/* Streams and links: how they are found, made, listed and forgotten. */

#ifndef AFTERIMAGE_STATE_H
#define AFTERIMAGE_STATE_H

#include "afterimage_keys.h"
#include "afterimage_pool.h"

#define SCALES 5
#define LANES 8 /* of the widest registers */
#define MEMO_SLOTS 4096

#define EACH_SCALE(k) for (int k = 0; k < SCALES; k++)

/* One missed packet, kept for peers that have not needed it yet.  Every peer that replays two packets in a row damps by
 * the time between them: those factors are computed once. */
typedef struct {
    uint64_t order;
    double time;
    double since; /* the hub's packet before */
    double factor[SCALES];
    double residual[SCALES], zero[LANES - SCALES];
} Event;

typedef struct {
    Key key;
    double last, touched;
    double cf1[SCALES], cf2[SCALES], w[SCALES];
    /* as of the stream's own last packet */
    double mean[SCALES], mean_squared[SCALES], var[SCALES], var_squared[SCALES], std[SCALES];
    /* bounded mode: damped sums over a hub's own packets, as of the latest of them */
    double spoken, count[SCALES], residuals[SCALES];
    uint64_t packets;
    int32_t first_link, last_link, first_hub_link, degree;
    int32_t self_link, hub, hub_links;
    Event *log;
    uint64_t logged, log_room;
} Stream;

typedef struct {
    int32_t end[2];
    double last;
    double cf3[SCALES], w3[SCALES];
    double residual[2][SCALES];
    int32_t next[2], previous[2], next_hub[2], previous_hub[2];
    uint64_t seen[2]; /* how much of each end's log has been replayed */
    /* bounded mode: each end's sums at that point */
    double then[2], count_then[2][SCALES], residuals_then[2][SCALES];
} Link;

typedef struct {
    Pool streams, links;
    Stream *stream; /* the cells of `streams` */
    Link *link;
    int32_t *logging; /* bounded mode: streams with a log, at most `most_logs` */
    int32_t logs, most_logs;
} Table;

typedef struct {
    double dt;
    double factor[SCALES];
} Memo;

typedef struct AfterImage {
    Table table[4];
    Memo memo[MEMO_SLOTS];
    uint64_t order, evicted_idle, evicted_full;
    double horizon, clock, offset;
    int bounded;
    int failed;
} AfterImage;

enum { MAC_IP, HOSTS, JITTER, SOCKETS };

static int side_of(const Link *link, int32_t at)
{
    return link->end[0] != at;
}

/* ---- finding ---- */

static int32_t find_stream(const Table *table, const Name *name)
{
    const Pool *pool = &table->streams;
    int32_t at = pool->bucket[name->hash & pool->mask];
    while (at != NONE
           && (pool->slot[at].hash != name->hash
               || memcmp(&table->stream[at].key, &name->key, (size_t)name->key.length + 1)))
        at = pool->slot[at].next;
    return at;
}

static int32_t find_link(const Table *table, int32_t a, int32_t b)
{
    const Pool *pool = &table->links;
    uint32_t hash = hash_pair(a, b);
    int32_t at = pool->bucket[hash & pool->mask];
    for (; at != NONE; at = pool->slot[at].next) {
        const Link *link = &table->link[at];
        if (pool->slot[at].hash == hash
            && ((link->end[0] == a && link->end[1] == b) || (link->end[0] == b && link->end[1] == a)))
            break;
    }
    return at;
}

/* ---- forgetting ---- */

static void leave_list(Table *table, int32_t at, int side)
{
    Link *link = &table->link[at];
    int32_t owner = link->end[side], before = link->previous[side], after = link->next[side];
    Stream *s = &table->stream[owner];
    if (before == NONE)
        s->first_link = after;
    else
        table->link[before].next[side_of(&table->link[before], owner)] = after;
    if (after == NONE)
        s->last_link = before;
    else
        table->link[after].previous[side_of(&table->link[after], owner)] = before;
    s->degree--;
}

/* Lists, for a stream, its links whose far end is a hub. */
static void join_hub_list(Table *table, int32_t at, int side)
{
    Link *link = &table->link[at];
    int32_t owner = link->end[side];
    Stream *s = &table->stream[owner];
    link->previous_hub[side] = NONE;
    link->next_hub[side] = s->first_hub_link;
    if (s->first_hub_link != NONE)
        table->link[s->first_hub_link].previous_hub[side_of(&table->link[s->first_hub_link], owner)] = at;
    s->first_hub_link = at;
    s->hub_links++;
}

static void leave_hub_list(Table *table, int32_t at, int side)
{
    const Link *link = &table->link[at];
    int32_t owner = link->end[side], before = link->previous_hub[side], after = link->next_hub[side];
    if (before == NONE)
        table->stream[owner].first_hub_link = after;
    else
        table->link[before].next_hub[side_of(&table->link[before], owner)] = after;
    if (after != NONE)
        table->link[after].previous_hub[side_of(&table->link[after], owner)] = before;
    table->stream[owner].hub_links--;
}

static void forget_link(Table *table, int32_t at)
{
    const Link *link = &table->link[at];
    leave_list(table, at, 0);
    if (link->end[0] == link->end[1])
        table->stream[link->end[0]].self_link = NONE;
    else {
        leave_list(table, at, 1);
        for (int side = 0; side < 2; side++)
            if (table->stream[link->end[side]].hub)
                leave_hub_list(table, at, !side);
    }
    pool_give_back(&table->links, at);
}

static void forget_log(Table *table, int32_t at)
{
    Stream *s = &table->stream[at];
    if (!s->log)
        return;
    free(s->log);
    s->log = NULL;
    s->logged = s->log_room = 0;
    for (int32_t n = 0; n < table->logs; n++)
        if (table->logging[n] == at) {
            table->logging[n] = table->logging[--table->logs];
            return;
        }
}

static void forget_stream(Table *table, int32_t at)
{
    while (table->stream[at].first_link != NONE)
        forget_link(table, table->stream[at].first_link);
    forget_log(table, at);
    pool_give_back(&table->streams, at);
}

/* Room for one packet: two streams and one link.  Idle streams go first, a few at a time. */
static void make_room(AfterImage *self, Table *table, double t)
{
    const Pool *streams = &table->streams, *links = &table->links;
    for (int n = 0; n < 3 && streams->oldest != NONE; n++) {
        if (!(t - table->stream[streams->oldest].touched > self->horizon))
            break;
        forget_stream(table, streams->oldest);
        self->evicted_idle++;
    }
    while (streams->live > streams->limit - 2) {
        forget_stream(table, streams->oldest);
        self->evicted_full++;
    }
    while (links->live > links->limit - 1) {
        forget_link(table, links->oldest);
        self->evicted_full++;
    }
}

/* ---- making ---- */

static int32_t enter(AfterImage *self, Table *table, const Name *name, double t)
{
    int32_t at = find_stream(table, name);
    if (at != NONE) {
        if (self->bounded) {
            pool_renew(&table->streams, at);
            table->stream[at].touched = t;
        }
        return at;
    }
    if ((at = pool_take(&table->streams, name->hash)) == NONE)
        return NONE;
    table->stream = table->streams.cells;
    Stream *s = &table->stream[at];
    memset(s, 0, sizeof *s);
    s->key = name->key;
    s->last = s->touched = t;
    EACH_SCALE(k) s->w[k] = 1e-20;
    s->first_link = s->last_link = s->first_hub_link = s->self_link = NONE;
    return at;
}

static void join_list(Table *table, int32_t at, int side)
{
    Link *link = &table->link[at];
    int32_t owner = link->end[side];
    Stream *s = &table->stream[owner];
    link->previous[side] = s->last_link;
    link->next[side] = NONE;
    if (s->last_link == NONE)
        s->first_link = at;
    else
        table->link[s->last_link].next[side_of(&table->link[s->last_link], owner)] = at;
    s->last_link = at;
    s->degree++;
}

static int32_t new_link(Table *table, int32_t a, int32_t b, double t)
{
    int32_t at = pool_take(&table->links, hash_pair(a, b));
    if (at == NONE)
        return NONE;
    table->link = table->links.cells;
    Link *link = &table->link[at];
    memset(link, 0, sizeof *link);
    link->end[0] = a;
    link->end[1] = b;
    link->last = t;
    EACH_SCALE(k) link->w3[k] = 1e-20;
    join_list(table, at, 0);
    if (a == b)
        table->stream[a].self_link = at;
    else
        join_list(table, at, 1);
    return at;
}

#endif
