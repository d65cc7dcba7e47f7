/* Hubs log their packets, peers replay them when they are next needed: see `afterimage.c`. */

#ifndef AFTERIMAGE_HUBS_H
#define AFTERIMAGE_HUBS_H

#include "afterimage_damping.h"

#define HUB_DEGREE 8
#define HUBS_ASKED 32 /* bounded mode */
#define LOG_KEPT 256 /* bounded mode; a power of two */
#define STREAMS_PER_LOG 128 /* bounded mode: 512 logs of 32 KiB beside 65,536 streams */
#define LEAST_LOGS 16

static Event *logged(const Stream *hub, uint64_t number)
{
    return &hub->log[number & (hub->log_room - 1)];
}

static void note_account(Link *link, int side, const Stream *hub)
{
    link->seen[side] = hub->logged;
    link->then[side] = hub->spoken;
    memcpy(link->count_then[side], hub->count, sizeof hub->count);
    memcpy(link->residuals_then[side], hub->residuals, sizeof hub->residuals);
}

/* Bounded mode: all packets of one end that the link has missed, in one step. */
static void account(AfterImage *self, const Table *table, Link *link, int side)
{
    static const double ONE[SCALES] = {1, 1, 1, 1, 1};
    const Stream *hub = &table->stream[link->end[side]];
    if (!hub->hub || link->seen[side] == hub->logged)
        return;
    double since[SCALES], until[SCALES], dt = hub->spoken - link->then[side];
    memcpy(since, dt > 0 ? factors(self, dt) : ONE, sizeof since);
    decay_link(self, link, hub->spoken, NULL);
    dt = link->last - hub->spoken;
    memcpy(until, dt > 0 ? factors(self, dt) : ONE, sizeof until);
    const double *other = link->residual[!side];
    EACH_SCALE(k)
    {
        double sum = hub->residuals[k] - link->residuals_then[side][k] * since[k];
        link->cf3[k] += sum * until[k] * other[k];
        link->w3[k] += (hub->count[k] - link->count_then[side][k] * since[k]) * until[k];
    }
    memcpy(link->residual[side], logged(hub, hub->logged - 1)->residual, sizeof link->residual[side]);
    note_account(link, side, hub);
}

static void account_long_misses(AfterImage *self, const Table *table, int32_t at)
{
    Link *link;
    for (int32_t i = table->stream[at].first_hub_link; i != NONE; i = link->next_hub[side_of(link, at)]) {
        link = &table->link[i];
        int far = !side_of(link, at);
        const Stream *hub = &table->stream[link->end[far]];
        if (hub->logged - link->seen[far] > LOG_KEPT) {
            decay_stream(self, &table->stream[at], hub->spoken);
            account(self, table, link, far);
        }
    }
}

/* The hub link whose next missed packet is the oldest; `until` is where another link's turn comes. */
static Link *next_to_replay(const Table *table, int32_t at, uint64_t *until)
{
    Link *first = NULL, *link;
    uint64_t order = UINT64_MAX;
    *until = UINT64_MAX;
    for (int32_t i = table->stream[at].first_hub_link; i != NONE; i = link->next_hub[side_of(link, at)]) {
        link = &table->link[i];
        int far = !side_of(link, at);
        const Stream *hub = &table->stream[link->end[far]];
        if (link->seen[far] == hub->logged)
            continue;
        uint64_t next = logged(hub, link->seen[far])->order;
        if (next < order) {
            *until = order;
            order = next;
            first = link;
        } else if (next < *until)
            *until = next;
    }
    return first;
}

/* All scales at once; what lies behind them in memory is read, too, and made zero. */
typedef double Wide __attribute__((vector_size(8 * LANES)));
typedef int64_t Mask __attribute__((vector_size(8 * LANES)));

#define WIDE(name, from)                                 \
    Wide name;                                           \
    memcpy(&name, from, sizeof name);                    \
    name = (Wide)((Mask)name & (Mask){-1, -1, -1, -1, -1})

/* Replays packets of one hub for as long as each damps stream and link by its own step: the same operations as those
 * of `decay_stream_at` and `update_link_at`, with the sums kept in registers. */
#define REPLAY_STEPS(name)                                                                       \
    static void name(Stream *s, Link *link, int far, const Stream *hub, uint64_t until)          \
    {                                                                                            \
        WIDE(cf1, s->cf1);                                                                       \
        WIDE(cf2, s->cf2);                                                                       \
        WIDE(w, s->w);                                                                           \
        WIDE(cf3, link->cf3);                                                                    \
        WIDE(w3, link->w3);                                                                      \
        WIDE(other, link->residual[!far]);                                                       \
        const Event *last = NULL;                                                                \
        double time = s->last;                                                                   \
        uint64_t seen = link->seen[far];                                                         \
        for (; seen < hub->logged; seen++) {                                                     \
            const Event *event = logged(hub, seen);                                              \
            if (event->order >= until || !(event->since > 0) || event->time - time != event->since) \
                break;                                                                           \
            Wide f, residual;                                                                    \
            memcpy(&f, event->factor, sizeof f);                                                 \
            memcpy(&residual, event->residual, sizeof residual);                                 \
            cf1 *= f;                                                                            \
            cf2 *= f;                                                                            \
            w *= f;                                                                              \
            cf3 = cf3 * f + residual * other;                                                    \
            w3 = w3 * f + 1;                                                                     \
            time = event->time;                                                                  \
            last = event;                                                                        \
        }                                                                                        \
        if (!last)                                                                               \
            return;                                                                              \
        s->last = link->last = time;                                                             \
        link->seen[far] = seen;                                                                  \
        memcpy(s->cf1, &cf1, sizeof s->cf1);                                                     \
        memcpy(s->cf2, &cf2, sizeof s->cf2);                                                     \
        memcpy(s->w, &w, sizeof s->w);                                                           \
        memcpy(link->cf3, &cf3, sizeof link->cf3);                                               \
        memcpy(link->w3, &w3, sizeof link->w3);                                                  \
        memcpy(link->residual[far], last->residual, sizeof link->residual[far]);                 \
    }

REPLAY_STEPS(replay_any)
#if defined(__x86_64__)
__attribute__((target("avx512f"))) REPLAY_STEPS(replay_avx512)
#endif

static void replay_steps(Stream *s, Link *link, int far, const Stream *hub, uint64_t until)
{
#if defined(__x86_64__)
    if (__builtin_cpu_supports("avx512f")) {
        replay_avx512(s, link, far, hub, until);
        return;
    }
#endif
    replay_any(s, link, far, hub, until);
}

/* Brings a stream up to date with the hubs it is linked to, packet by packet in their order. */
static void catch_up(AfterImage *self, const Table *table, int32_t at)
{
    Stream *s = &table->stream[at];
    if (self->bounded) {
        if (s->hub_links > HUBS_ASKED)
            return; /* too many to ask each: its links wait until they are addressed */
        account_long_misses(self, table, at);
    }
    Link *link;
    uint64_t until;
    while ((link = next_to_replay(table, at, &until))) {
        int far = !side_of(link, at);
        const Stream *hub = &table->stream[link->end[far]];
        while (link->seen[far] < hub->logged) {
            const Event *event = logged(hub, link->seen[far]);
            if (event->order >= until)
                break;
            if (s->packets && s->last == link->last && event->since > 0 && event->time - s->last == event->since) {
                replay_steps(s, link, far, hub, until);
                continue;
            }
            link->seen[far]++;
            decay_stream_at(self, s, event->time, event);
            update_link_at(self, link, far, event->residual, event->time, event);
        }
        if (self->bounded && link->seen[far] == hub->logged)
            note_account(link, far, hub);
    }
}

/* Bounded mode: all peers catch up with a hub, which begins a new log with its next packet. */
static void end_log(AfterImage *self, Table *table, int32_t at)
{
    const Stream *hub = &table->stream[at];
    for (int32_t i = hub->first_link; i != NONE;) {
        Link *link = &table->link[i];
        int near = side_of(link, at);
        if (i != hub->self_link) {
            account(self, table, link, near);
            link->seen[near] = 0;
        }
        i = link->next[near];
    }
    forget_log(table, at);
}

typedef struct {
    uint64_t order; /* of the last packet */
    int32_t at;
} Silence;

static int by_order(const void *a, const void *b)
{
    uint64_t one = ((const Silence *)a)->order, other = ((const Silence *)b)->order;
    return (one > other) - (one < other);
}

/* Bounded mode: before a hub's first packet is logged.  Where there are too many logs, those of the quarter of hubs that
 * have been silent for longest end at once: choosing among all is as much work as that. */
static void begin_log(AfterImage *self, Table *table, int32_t at)
{
    if (table->logs == table->most_logs) {
        Silence *hubs = malloc((size_t)table->logs * sizeof *hubs);
        if (!hubs) {
            self->failed = 1;
            return;
        }
        int32_t count = table->logs;
        for (int32_t n = 0; n < count; n++) {
            const Stream *hub = &table->stream[table->logging[n]];
            hubs[n].order = logged(hub, hub->logged - 1)->order;
            hubs[n].at = table->logging[n];
        }
        qsort(hubs, (size_t)count, sizeof *hubs, by_order);
        for (int32_t n = 0; n < count / 4; n++)
            end_log(self, table, hubs[n].at);
        free(hubs);
    }
    table->logging[table->logs++] = at;
}

static void log_event(AfterImage *self, Table *table, int32_t at, double t, const double *residual)
{
    Stream *hub = &table->stream[at];
    if (self->bounded && !hub->log) {
        begin_log(self, table, at);
        if (self->failed)
            return;
    }
    if (hub->logged == hub->log_room && !(self->bounded && hub->log_room == LOG_KEPT)) {
        uint64_t room = hub->log_room ? hub->log_room * 2 : 16;
        Event *larger = realloc(hub->log, room * sizeof *larger);
        if (!larger) {
            self->failed = 1;
            return;
        }
        hub->log = larger;
        hub->log_room = room;
    }
    double since = hub->logged ? t - logged(hub, hub->logged - 1)->time : 0;
    Event *event = logged(hub, hub->logged++);
    event->order = self->order;
    event->time = t;
    event->since = since;
    if (since > 0)
        memcpy(event->factor, factors(self, since), sizeof event->factor);
    memcpy(event->residual, residual, sizeof event->residual);
    memset(event->zero, 0, sizeof event->zero);
    if (!self->bounded)
        return;
    if (t > hub->spoken) {
        const double *f = factors(self, t - hub->spoken);
        EACH_SCALE(k)
        {
            hub->count[k] *= f[k];
            hub->residuals[k] *= f[k];
        }
        hub->spoken = t;
    }
    EACH_SCALE(k)
    {
        hub->count[k] += 1;
        hub->residuals[k] += residual[k];
    }
}

/* All links of the sender see its packet: at once, or through the log. */
static void tell_links(AfterImage *self, Table *table, int32_t at, const double *residual, double t)
{
    Stream *s = &table->stream[at];
    if (s->self_link != NONE) {
        /* a self link is listed twice as published, and its far end is the sender itself */
        update_link(self, &table->link[s->self_link], 0, residual, t);
        update_link(self, &table->link[s->self_link], 0, residual, t);
    }
    if (s->hub) {
        log_event(self, table, at, t, residual);
        return;
    }
    for (int32_t i = s->first_link; i != NONE;) {
        Link *link = &table->link[i];
        int near = side_of(link, at);
        int32_t peer = link->end[!near];
        if (peer != at) {
            catch_up(self, table, peer);
            decay_stream(self, &table->stream[peer], t);
            update_link(self, link, near, residual, t);
        }
        i = link->next[near];
    }
}

/* A new link: whoever has one too many now logs from here on, and its peers know it as a hub. */
static void tell_hubs(Table *table, int32_t at)
{
    const Link *link = &table->link[at];
    if (link->end[0] == link->end[1])
        return;
    for (int side = 0; side < 2; side++) {
        int32_t owner = link->end[side];
        Stream *s = &table->stream[owner];
        if (s->hub) {
            join_hub_list(table, at, !side);
            note_account(&table->link[at], side, s);
        } else if (s->degree > HUB_DEGREE) {
            s->hub = 1;
            s->spoken = s->last;
            for (int32_t i = s->first_link; i != NONE; i = table->link[i].next[side_of(&table->link[i], owner)]) {
                if (i == s->self_link)
                    continue;
                int near = side_of(&table->link[i], owner);
                join_hub_list(table, i, !near);
                note_account(&table->link[i], near, s);
            }
        }
    }
}

#endif
