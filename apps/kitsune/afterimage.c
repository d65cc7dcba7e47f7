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
 * one step however many packets, which differs in rounding; so do the peers of hubs that have been silent for longest
 * when there are too many logs.  It forgets streams that have decayed, never holds more than the given numbers of
 * streams and links, and its clock never runs backwards.
 *
 * Build with -ffp-contract=off -fno-builtin-pow: pow(x, 2) and x * x differ in the last bit, and the
 * variance of a constant stream consists of such bits.
 */

#include <math.h>

#include "afterimage_hubs.h"

#define FEATURES 100
#define SET_BACK 60.0 /* bounded mode, s: a packet this much too old means that the clock was set back */

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
    return 11;
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
        if (!bounded)
            continue;
        table->most_logs = max_streams / STREAMS_PER_LOG > LEAST_LOGS ? max_streams / STREAMS_PER_LOG : LEAST_LOGS;
        if (!(table->logging = malloc((size_t)table->most_logs * sizeof *table->logging)))
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
        free(table->logging);
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

/* Streams, links, streams forgotten for age, cells forgotten for room, logs of hubs (bounded mode). */
void afterimage_counts(const AfterImage *self, uint64_t *out)
{
    out[0] = out[1] = out[4] = 0;
    for (int i = 0; i < 4; i++) {
        out[0] += (uint64_t)self->table[i].streams.live;
        out[1] += (uint64_t)self->table[i].links.live;
        out[4] += (uint64_t)self->table[i].logs;
    }
    out[2] = self->evicted_idle;
    out[3] = self->evicted_full;
}

#include "afterimage_dump.h"
