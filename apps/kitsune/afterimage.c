/* AfterImage: 100 damped statistics per packet, bit-equal to the published implementation.
 *
 * A packet touches four tables of streams.  Two of them (hosts, sockets) also keep links between
 * pairs of streams.  As published, a packet updates every link of its sender and decays every peer.
 *
 * Reference mode gives exactly these numbers without the fan-out: a sender with many links (a hub)
 * writes its packets to a log, and a peer replays what it missed, step by step, when it is next
 * needed.  The order of floating-point operations on each stream and link stays the published one.
 *
 * Bounded mode keeps only the last packets of a log: who has missed more catches up in closed form,
 * one step however many packets, which differs in rounding.  It forgets streams that have decayed, never
 * holds more than the given numbers of streams and links, and its clock never runs backwards.
 *
 * Build with -ffp-contract=off -fno-builtin-pow: pow(x, 2) and x * x differ in the last bit, and the
 * variance of a constant stream consists of such bits.
 */

#include <math.h>

#include "afterimage_state.h"

#define FEATURES 100
#define HUB_DEGREE 8
#define HUBS_ASKED 32 /* bounded mode */
#define SET_BACK 60.0 /* bounded mode, s: a packet this much too old means that the clock was set back */
#define LOG_KEPT 256 /* bounded mode; a power of two */

static const double LAMBDA[SCALES] = {5, 3, 1, 0.1, 0.01};

/* ---- damping ---- */

static const double *factors(AfterImage *self, double dt)
{
    uint64_t bits;
    memcpy(&bits, &dt, 8);
    Memo *memo = &self->memo[mix(bits) % MEMO_SLOTS];
    if (memo->dt != dt) {
        memo->dt = dt;
        EACH_SCALE(k) memo->factor[k] = pow(2, -LAMBDA[k] * dt);
    }
    return memo->factor;
}

/* As `factors`; `event` is the packet that is replayed, or NULL. */
static const double *factors_at(AfterImage *self, double dt, const Event *event)
{
    return event && event->since == dt ? event->factor : factors(self, dt);
}

static void decay_stream_at(AfterImage *self, Stream *s, double t, const Event *event)
{
    double dt = t - s->last;
    if (!(dt > 0))
        return;
    s->last = t;
    if (!s->packets) /* nothing to damp yet: 1e-20 + 1 is 1 at any age */
        return;
    const double *f = factors_at(self, dt, event);
    EACH_SCALE(k)
    {
        s->cf1[k] *= f[k];
        s->cf2[k] *= f[k];
        s->w[k] *= f[k];
    }
}

static void decay_stream(AfterImage *self, Stream *s, double t)
{
    decay_stream_at(self, s, t, NULL);
}

static void decay_link(AfterImage *self, Link *link, double t, const Event *event)
{
    double dt = t - link->last;
    if (!(dt > 0))
        return;
    link->last = t;
    const double *f = factors_at(self, dt, event);
    EACH_SCALE(k)
    {
        link->cf3[k] *= f[k];
        link->w3[k] *= f[k];
    }
}

static void update_link_at(AfterImage *self, Link *link, int side, const double *residual, double t, const Event *event)
{
    decay_link(self, link, t, event);
    double *other = link->residual[!side];
    EACH_SCALE(k)
    {
        link->cf3[k] += residual[k] * other[k];
        link->w3[k] += 1;
        link->residual[side][k] = residual[k];
    }
}

static void update_link(AfterImage *self, Link *link, int side, const double *residual, double t)
{
    update_link_at(self, link, side, residual, t, NULL);
}

static void insert(AfterImage *self, Stream *s, double v, double t)
{
    decay_stream(self, s, t);
    double square = pow(v, 2);
    EACH_SCALE(k)
    {
        s->cf1[k] += v;
        s->cf2[k] += square;
        s->w[k] += 1;
        s->mean[k] = s->cf1[k] / s->w[k];
        s->mean_squared[k] = pow(s->mean[k], 2);
        s->var[k] = fabs(s->cf2[k] / s->w[k] - s->mean_squared[k]);
        s->std[k] = sqrt(s->var[k]);
    }
    s->packets++;
}

/* ---- hubs log, peers replay ---- */

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

static void log_event(AfterImage *self, Stream *hub, double t, const double *residual)
{
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
        log_event(self, s, t, residual);
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

/* ---- one packet ---- */

static int32_t addressed_link(AfterImage *self, Table *table, int32_t a, int32_t b, double t)
{
    int32_t at;
    /* the published search takes a self pair for the first link of its stream */
    if (a == b)
        at = table->stream[a].first_link;
    else
        at = find_link(table, a, b);
    if (at == NONE) {
        if ((at = new_link(table, a, b, t)) == NONE)
            return NONE;
        tell_hubs(table, at);
    } else if (self->bounded)
        pool_renew(&table->links, at);
    return at;
}

static void put_1d(const Stream *s, double *out, int stride)
{
    EACH_SCALE(k)
    {
        out[k * stride] = s->w[k];
        out[k * stride + 1] = s->mean[k];
        out[k * stride + 2] = s->var[k];
    }
}

static void put_2d(const Table *table, const Link *link, double *out)
{
    const Stream *a = &table->stream[link->end[0]], *b = &table->stream[link->end[1]];
    EACH_SCALE(k)
    {
        double *o = out + 7 * k, cov = link->cf3[k] / link->w3[k], both = a->std[k] * b->std[k];
        o[3] = sqrt(a->var_squared[k] + b->var_squared[k]);
        o[4] = sqrt(a->mean_squared[k] + b->mean_squared[k]);
        o[5] = cov;
        o[6] = both != 0 ? cov / both : 0;
    }
}

static void packet_1d(AfterImage *self, Table *table, const Name *name, int jitter, double v, double t, double *out)
{
    if (self->bounded)
        make_room(self, table, t);
    int32_t at = enter(self, table, name, t);
    if (at == NONE) {
        self->failed = 1;
        return;
    }
    Stream *s = &table->stream[at];
    if (jitter)
        v = t - s->last > 0 ? t - s->last : 0;
    insert(self, s, v, t);
    put_1d(s, out, 3);
}

/* The sender's packet in its own statistics and, through its links, in those of its peers. */
static void speak(AfterImage *self, Table *table, int32_t at, double v, double t, double *residual)
{
    Stream *s = &table->stream[at];
    catch_up(self, table, at);
    insert(self, s, v, t);
    EACH_SCALE(k)
    {
        residual[k] = v - s->mean[k];
        s->var_squared[k] = pow(s->var[k], 2);
    }
    tell_links(self, table, at, residual, t);
}

static void packet_2d(AfterImage *self, Table *table, const Name *src, const Name *dst, double v, double t, double *out)
{
    double residual[SCALES];
    if (self->bounded)
        make_room(self, table, t);
    int32_t a = enter(self, table, src, t);
    if (a != NONE) {
        speak(self, table, a, v, t, residual);
        put_1d(&table->stream[a], out, 7);
    }
    int32_t b = a == NONE ? NONE : enter(self, table, dst, t);
    int32_t at = b == NONE ? NONE : addressed_link(self, table, a, b, t);
    if (at == NONE) {
        self->failed = 1;
        return;
    }
    Link *link = &table->link[at];
    int near = side_of(link, a), far = link->end[!near];
    catch_up(self, table, far);
    if (self->bounded && far != a) {
        account(self, table, link, !near);
        account(self, table, link, near);
    }
    decay_stream(self, &table->stream[far], t);
    update_link(self, link, near, residual, t);
    put_2d(table, link, out);
}

/* ---- what the next packet will need is fetched while this one is worked on ---- */

static int32_t prefetch_stream(const Table *table, const Name *name)
{
    const Pool *pool = &table->streams;
    int32_t at = pool->bucket[name->hash & pool->mask];
    while (at != NONE && pool->slot[at].hash != name->hash)
        at = pool->slot[at].next;
    if (at != NONE)
        for (size_t line = 0; line < sizeof(Stream); line += 64)
            __builtin_prefetch((const char *)&table->stream[at] + line);
    return at;
}

static void prefetch_pair(const Table *table, const Name *src, const Name *dst)
{
    int32_t a = prefetch_stream(table, src), b = prefetch_stream(table, dst);
    if (a == NONE || b == NONE)
        return;
    const Pool *pool = &table->links;
    int32_t at = pool->bucket[hash_pair(a, b) & pool->mask];
    if (at != NONE)
        for (size_t line = 0; line < sizeof(Link); line += 64)
            __builtin_prefetch((const char *)&table->link[at] + line);
}

static void prefetch_packet(const AfterImage *self, const Names *names)
{
    prefetch_stream(&self->table[MAC_IP], &names->mac_ip);
    prefetch_pair(&self->table[HOSTS], &names->host, &names->peer_host);
    prefetch_stream(&self->table[JITTER], &names->hosts);
    prefetch_pair(&self->table[SOCKETS], &names->socket, &names->peer_socket);
}

/* ---- interface ---- */

/* Grows with every change of the interface, so that a library left over from before is noticed. */
int32_t kitsune_kernel_version(void)
{
    return 7;
}

AfterImage *afterimage_new(int bounded, int32_t max_streams, int32_t max_links, double horizon)
{
    AfterImage *self = calloc(1, sizeof *self);
    if (!self)
        return NULL;
    self->bounded = bounded;
    self->horizon = horizon;
    self->clock = -HUGE_VAL;
    for (int i = 0; i < 4; i++) {
        Table *table = &self->table[i];
        if (pool_start(&table->streams, sizeof(Stream), bounded ? max_streams : 0)
            || pool_start(&table->links, sizeof(Link), bounded ? max_links : 0))
            self->failed = 1;
    }
    return self;
}

void afterimage_free(AfterImage *self)
{
    for (int i = 0; i < 4; i++) {
        Table *table = &self->table[i];
        for (int32_t n = 0; n < table->streams.used; n++)
            free(table->stream[n].log);
        pool_end(&table->streams);
        pool_end(&table->links);
    }
    free(self);
}

static double steady(AfterImage *self, double t)
{
    if (!self->bounded)
        return t;
    if (t + self->offset < self->clock - SET_BACK)
        self->offset = self->clock - t;
    t += self->offset;
    if (t > self->clock)
        self->clock = t;
    return self->clock;
}

static void packet(AfterImage *self, const Names *names, double v, double t, double *out)
{
    self->order++;
    packet_1d(self, &self->table[MAC_IP], &names->mac_ip, 0, v, t, out);
    packet_2d(self, &self->table[HOSTS], &names->host, &names->peer_host, v, t, out + 15);
    packet_1d(self, &self->table[JITTER], &names->hosts, 1, v, t, out + 50);
    packet_2d(self, &self->table[SOCKETS], &names->socket, &names->peer_socket, v, t, out + 65);
}

/* Adds n packets in order and writes 100 features for each.
 *
 * `lengths` are those of the columns, in the order of the struct, `room` is that of `out` in numbers.
 * -1 when memory is short, -2 when a column or `out` is too short: then nothing was read. */
int afterimage_update(AfterImage *self, const Columns *columns, const long *lengths, long n, double *out, long room)
{
    Names names[2];
    if (n < 0 || n > room / FEATURES)
        return -2;
    for (size_t i = 0; i < COLUMNS; i++)
        if (lengths[i] < n)
            return -2;
    if (n > 0)
        read_names(columns, 0, &names[0]);
    for (long i = 0; i < n && !self->failed; i++, out += FEATURES) {
        if (i + 1 < n) {
            read_names(columns, i + 1, &names[(i + 1) & 1]);
            prefetch_packet(self, &names[(i + 1) & 1]);
        }
        packet(self, &names[i & 1], columns->length[i], steady(self, columns->time[i]), out);
    }
    return self->failed ? -1 : 0;
}

/* Streams, links, streams forgotten for age, cells forgotten for room. */
void afterimage_counts(const AfterImage *self, uint64_t *out)
{
    out[0] = out[1] = 0;
    for (int i = 0; i < 4; i++) {
        out[0] += (uint64_t)self->table[i].streams.live;
        out[1] += (uint64_t)self->table[i].links.live;
    }
    out[2] = self->evicted_idle;
    out[3] = self->evicted_full;
}

#include "afterimage_dump.h"
