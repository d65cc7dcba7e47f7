/* Columns as rows, which all trackers read; and what of each kind of flood comes to each host: `victims.py` in C. */

#include "packet_rows.h"

/* In the order of `kernel.ROW_FIELDS`. */
typedef struct {
    const uint32_t *length;
    const double *time;
    const uint64_t *eth_src, *eth_dst;
    const int32_t *arp_op;
    const uint32_t *arp_src_ip, *arp_dst_ip;
    const uint8_t *ip_version;
    const uint64_t *ip_src_hi, *ip_src_lo, *ip_dst_hi, *ip_dst_lo;
    const int32_t *tcp_sport, *tcp_dport, *udp_sport, *udp_dport, *icmp_type;
    const uint64_t *arrival;
    const uint16_t *port;
    const uint8_t *quoted, *tcp_flags;
    const int32_t *icmp6_type;
} PacketRows;

static int64_t whole_second(double time)
{
    return time >= -9e18 && time <= 9e18 ? (int64_t)time : 0;
}

static inline void read_row(const PacketRows *c, long i, Row *row)
{
    int32_t arp_op = c->arp_op[i], icmp = c->icmp_type[i], icmp6 = c->icmp6_type[i];
    int32_t tcp_sport = c->tcp_sport[i], udp_sport = c->udp_sport[i], udp_dport = c->udp_dport[i];
    int is_arp = arp_op >= 0, is_tcp = tcp_sport >= 0, is_udp = udp_sport >= 0, is_quoted = c->quoted[i] != 0;
    int is_ping = icmp == 8 || icmp6 == 128, is_pong = icmp == 0 || icmp6 == 129;
    int32_t sport = is_tcp ? tcp_sport : udp_sport, dport = is_tcp ? c->tcp_dport[i] : udp_dport;
    int64_t base = is_arp ? ARP : is_tcp ? TCP : is_udp ? UDP : is_ping || is_pong ? ECHO : OTHER;
    int to_group = c->eth_dst[i] >> 40 & 1;
    uint8_t version = is_arp ? 4 : c->ip_version[i];
    row->time = c->time[i];
    row->second = whole_second(c->time[i]);
    row->arrival = c->arrival[i];
    row->mac = c->eth_src[i] & 0xFFFFFFFFFFFFu;
    row->to_mac = c->eth_dst[i] & 0xFFFFFFFFFFFFu;
    row->source = address_of(version, c->ip_src_hi[i], is_arp ? c->arp_src_ip[i] : c->ip_src_lo[i]);
    row->target = address_of(version, c->ip_dst_hi[i], is_arp ? c->arp_dst_ip[i] : c->ip_dst_lo[i]);
    row->service = base + (is_tcp || is_udp ? dport : 0);
    row->reverse = base + (is_tcp || is_udp ? sport : 0);
    row->sport = sport;
    row->dport = dport;
    row->udp_sport = is_quoted ? -1 : udp_sport;
    row->udp_dport = udp_dport;
    row->length = c->length[i];
    row->port = c->port[i];
    row->flags = c->tcp_flags[i];
    row->is_arp = is_arp;
    row->is_tcp = is_tcp;
    row->is_udp = is_udp;
    row->is_ping = is_ping;
    row->to_group = to_group;
    row->group = to_group && !(is_arp && arp_op == 1);
    row->quoted = is_quoted;
    row->answer = arp_op == 2 || is_pong || (is_arp && c->arp_src_ip[i] == c->arp_dst_ip[i]) || base == OTHER;
}

/* As `afterimage.seconds` does it: whole seconds and the rest apart. */
void seconds_of(const int64_t *nanoseconds, long n, double *out)
{
    for (long i = 0; i < n; i++) {
        int64_t whole = nanoseconds[i] / 1000000000, rest = nanoseconds[i] % 1000000000;
        if (rest < 0) {
            rest += 1000000000;
            whole--;
        }
        out[i] = (double)whole + (double)rest / 1e9;
    }
}

/* Bytes that `rows_read` needs for each row. */
long row_bytes(void)
{
    return sizeof(Row);
}

void rows_read(const PacketRows *columns, long n, Row *rows)
{
    const PacketRows c = *columns; /* which no row can overwrite */
    for (long i = 0; i < n; i++)
        read_row(&c, i, &rows[i]);
}

/* ---- SYNs that carry their destination's address as sequence number: `behaviour/fingerprints.py` */

static inline int opens(const PacketRows *c, long i)
{
    return c->tcp_sport[i] >= 0 && (c->tcp_flags[i] & (FIN | SYN | RST | ACK)) == SYN && !c->quoted[i];
}

static inline int is_marked(const PacketRows *c, const uint32_t *sequence, long i)
{
    return sequence[i] == c->ip_dst_lo[i] && c->ip_version[i] == 4;
}

/* By whom row `at` was sent: the number of a sender among `count`, by a row of each; `count` for another one. */
static int32_t whose(const PacketRows *c, const int32_t *senders, int32_t count, long at)
{
    for (int32_t i = count - 1; i >= 0; i--) {
        long row = senders[i];
        if (c->eth_src[row] == c->eth_src[at] && c->ip_src_lo[row] == c->ip_src_lo[at] && c->port[row] == c->port[at])
            return i;
    }
    return count;
}

/* Of the first `trained` of n rows: how many open a connection, and how many of those are marked, to out[0] and [1].
 * Of the others the first marked ones, up to `most`: their numbers, the number of the sender of each, and one row of
 * each sender (room for `most` each); the number of senders goes to out[2].  Returns how many rows there are. */
long rows_marked(const PacketRows *columns, const uint32_t *sequence, long n, long trained, long most, int32_t *rows, int32_t *by, int32_t *senders, int64_t *out)
{
    const PacketRows c = *columns;
    long found = 0, i = 0;
    out[0] = out[1] = out[2] = 0;
    for (; i < n && i < trained; i++)
        if (opens(&c, i)) {
            out[0]++;
            out[1] += is_marked(&c, sequence, i);
        }
    for (; i < n && found < most; i++)
        if (is_marked(&c, sequence, i) && opens(&c, i)) {
            rows[found] = (int32_t)i;
            by[found] = whose(&c, senders, (int32_t)out[2], i);
            if (by[found] == out[2])
                senders[out[2]++] = (int32_t)i;
            found++;
        }
    return found;
}

/* Marked SYNs of one sender. */
typedef struct {
    uint64_t mac, source;
    double newest;
    int32_t port, first, count;
} MarkedSender;

/* Who sent the `found` rows that `rows_marked` returned: `count` senders, and the times of each, seconds, beginning with
 * number `first` in `times`; a time that goes back is the one before it. */
void marked_senders(const PacketRows *c, const int64_t *time_us, long found, const int32_t *rows, const int32_t *by, long count, const int32_t *senders, MarkedSender *out, double *times)
{
    for (long i = 0; i < count; i++) {
        long row = senders[i];
        MarkedSender whose = {c->eth_src[row], c->ip_src_lo[row], -INFINITY, c->port[row], 0, 0};
        out[i] = whose;
    }
    for (long i = 0; i < found; i++)
        out[by[i]].count++;
    for (long i = 1; i < count; i++) {
        out[i].first = out[i - 1].first + out[i - 1].count;
        out[i - 1].count = 0;
    }
    if (count)
        out[count - 1].count = 0;
    for (long i = 0; i < found; i++) {
        MarkedSender *whose = &out[by[i]];
        double time = (double)time_us[rows[i]] / 1e6;
        if (time > whose->newest)
            whose->newest = time;
        times[whose->first + whose->count++] = whose->newest;
    }
}

static int is_among(const uint64_t *sorted, long n, uint64_t mac)
{
    long low = 0;
    while (low < n) {
        long middle = low + (n - low) / 2;
        if (sorted[middle] == mac)
            return 1;
        if (sorted[middle] < mac)
            low = middle + 1;
        else
            n = middle;
    }
    return 0;
}

/* How many scores from number `first` on are at or above the threshold, or no number. */
long scores_over(const double *scores, long first, long last, double threshold)
{
    long count = 0;
    for (long i = first; i < last; i++)
        count += !(scores[i] < threshold);
    return count;
}

/* Rows from `first` on that neither come from one of m MACs (ascending) nor go to one: how many score above the
 * threshold, and the first and last time among them; returns how many there are. */
long rows_benign(const Row *rows, long first, long last, const double *scores, double threshold, const uint64_t *macs, long m, double *out)
{
    long count = 0, above = 0;
    double least = INFINITY, most = -INFINITY;
    int known = 1;
    for (long i = first; i < last; i++) {
        if (is_among(macs, m, rows[i].mac) || is_among(macs, m, rows[i].to_mac))
            continue;
        double time = rows[i].time;
        count++;
        above += !(scores[i] <= threshold);
        least = time < least ? time : least;
        most = time > most ? time : most;
        known &= time == time;
    }
    out[0] = (double)above;
    out[1] = known ? least : NAN;
    out[2] = known ? most : NAN;
    return count;
}

/* ---- victims */

typedef struct {
    int64_t highest, packets;
    int32_t sources;
} Usual;

typedef struct {
    int64_t most_kinds, most_sources, most_sources_of_all, back_s;
} VictimLimits;

typedef struct {
    VictimLimits limits;
    Table now, last, usual, sources; /* counts of the open second and the one before; of training */
    int64_t second, named;
    int failed;
} Victims;

void victims_free(Victims *v)
{
    if (!v)
        return;
    table_end(&v->now);
    table_end(&v->last);
    table_end(&v->usual);
    table_end(&v->sources);
    free(v);
}

Victims *victims_new(const VictimLimits *limits, uint64_t seed)
{
    Victims *v = calloc(1, sizeof *v);
    if (!v)
        return NULL;
    v->limits = *limits;
    v->second = -1;
    if (table_start(&v->now, sizeof(int64_t), seed) | table_start(&v->last, sizeof(int64_t), seed) | table_start(&v->usual, sizeof(Usual), seed)
        | table_start(&v->sources, sizeof(int64_t), seed)) {
        victims_free(v);
        return NULL;
    }
    return v;
}

static int32_t entry_of(Victims *v, Table *table, const Key *key, int may_add)
{
    int32_t at = find_key(table, key);
    if (at == NONE && may_add) {
        at = add_key(table, key);
        v->failed |= at == NONE;
    }
    return at;
}

static void learn(Victims *v, const Key *key, Address source, int64_t now)
{
    int32_t at = entry_of(v, &v->usual, key, v->usual.live < v->limits.most_kinds);
    if (at == NONE)
        return;
    Usual *usual = payload(&v->usual, at);
    if (now > usual->highest)
        usual->highest = now;
    usual->packets++;
    const uint64_t *word = key->subject.word;
    Key by_source = keyed(&v->sources, (Subject){{word[0], word[1], word[2], word[3], source.hi, source.lo}});
    int32_t found = find_key(&v->sources, &by_source);
    if (found == NONE) {
        if (usual->sources >= v->limits.most_sources || v->named >= v->limits.most_sources_of_all)
            return;
        found = entry_of(v, &v->sources, &by_source, 1);
        if (found == NONE)
            return;
        usual->sources++;
        v->named++;
    }
    ++*(int64_t *)payload(&v->sources, found);
}

static void count_kind(Victims *v, const Row *row, int64_t kind, int trains)
{
    Key key = keyed(&v->now, pair_of((uint32_t)kind, is_six(row->target), row->target, (Address){0, 0, 0}));
    int32_t at = entry_of(v, &v->now, &key, v->now.live < v->limits.most_kinds);
    int64_t now = at == NONE ? 0 : ++*(int64_t *)payload(&v->now, at);
    if (trains)
        learn(v, &key, row->source, now);
}

static void turn(Victims *v, int64_t second)
{
    if (second <= v->second && second >= v->second - v->limits.back_s)
        return;
    v->second = second;
    Table last = v->last;
    v->last = v->now;
    v->now = last;
    table_clear(&v->now);
}

static int kinds_of(const Row *row, int64_t *kinds)
{
    int count = 0;
    if (row->is_udp) {
        int64_t sport = row->udp_sport, dport = row->udp_dport & 0xFFFF;
        kinds[count++] = sport < WELL_KNOWN ? FROM_UDP | sport : UDP | dport;
        kinds[count++] = ANY_UDP;
    }
    if (row->is_tcp && !(row->flags & SYN))
        kinds[count++] = STRAY_TCP | (row->dport & 0xFFFF);
    if (row->is_ping && !row->is_tcp && !row->is_udp)
        kinds[count++] = ECHO;
    return count;
}

/* n rows, of which the first `trained` were training; -1 when memory is short. */
int victims_add(Victims *v, const Row *rows, long n, long trained)
{
    for (long i = 0; i < n && !v->failed; i++) {
        const Row *row = &rows[i];
        if (row->is_arp || row->quoted || !row->target.version)
            continue;
        int64_t kinds[4];
        int count = kinds_of(row, kinds);
        if (count)
            turn(v, row->second);
        for (int kind = 0; kind < count; kind++)
            count_kind(v, row, kinds[kind], i < trained);
    }
    return v->failed ? -1 : 0;
}

/* Packets of one kind towards a host in the open second, or in the one before if that were more. */
int64_t victims_rate(const Victims *v, uint64_t kind, int32_t six, uint64_t hi, uint64_t lo)
{
    Subject key = {{kind, six != 0, hi, lo, 0, 0}};
    int32_t now = table_find(&v->now, &key), last = table_find(&v->last, &key);
    int64_t one = now == NONE ? 0 : *(int64_t *)payload(&v->now, now), other = last == NONE ? 0 : *(int64_t *)payload(&v->last, last);
    return one > other ? one : other;
}

/* What training saw: kind, six, host, highest, packets. */
long victims_usual(const Victims *v, uint64_t *out, long room)
{
    long count = 0;
    for (int32_t at = v->usual.oldest; at != NONE; at = head(&v->usual, at)->newer, count++) {
        if (count >= room)
            continue;
        const Usual *usual = payload(&v->usual, at);
        memcpy(out + 6 * count, &head(&v->usual, at)->key, 4 * sizeof *out);
        out[6 * count + 4] = (uint64_t)usual->highest;
        out[6 * count + 5] = (uint64_t)usual->packets;
    }
    return count;
}

/* Who sent it: kind, six, host, source, packets. */
long victims_sources(const Victims *v, uint64_t *out, long room)
{
    long count = 0;
    for (int32_t at = v->sources.oldest; at != NONE; at = head(&v->sources, at)->newer, count++) {
        if (count >= room)
            continue;
        memcpy(out + 7 * count, &head(&v->sources, at)->key, sizeof(Subject));
        out[7 * count + 6] = *(uint64_t *)payload(&v->sources, at);
    }
    return count;
}

#include "victims_dump.h"
