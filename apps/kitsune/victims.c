/* What of each kind of flood comes to each host: `victims.py` in C. */

#include "ledger_rows.h"

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

static int32_t entry_of(Victims *v, Table *table, const Subject *key, int may_add)
{
    int32_t at = table_find(table, key);
    if (at == NONE && may_add) {
        at = table_add(table, key);
        v->failed |= at == NONE;
    }
    return at;
}

static void learn(Victims *v, const Subject *key, Address source, int64_t now)
{
    int32_t at = entry_of(v, &v->usual, key, v->usual.live < v->limits.most_kinds);
    if (at == NONE)
        return;
    Usual *usual = payload(&v->usual, at);
    if (now > usual->highest)
        usual->highest = now;
    usual->packets++;
    Subject by_source = {{key->word[0], key->word[1], key->word[2], key->word[3], source.hi, source.lo}};
    int32_t found = table_find(&v->sources, &by_source);
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
    Subject key = pair_of((uint32_t)kind, is_six(row->target), row->target, (Address){0, 0, 0});
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

static int kinds_of(const PacketRows *rows, long i, const Row *row, int64_t *kinds)
{
    int count = 0;
    if (row->is_udp) {
        int64_t sport = rows->udp_sport[i], dport = rows->udp_dport[i] & 0xFFFF;
        kinds[count++] = sport < WELL_KNOWN ? FROM_UDP | sport : UDP | dport;
        kinds[count++] = ANY_UDP;
    }
    if (row->is_tcp && !(row->flags & SYN))
        kinds[count++] = STRAY_TCP | (rows->tcp_dport[i] & 0xFFFF);
    if (row->is_ping && !row->is_tcp && !row->is_udp)
        kinds[count++] = ECHO;
    return count;
}

/* n rows, of which the first `trained` were training; -1 when memory is short. */
int victims_add(Victims *v, const PacketRows *rows, long n, long trained)
{
    for (long i = 0; i < n && !v->failed; i++) {
        Row row;
        if (rows->arp_op[i] >= 0)
            continue;
        read_row(rows, i, &row);
        if (row.quoted || !row.target.version)
            continue;
        int64_t kinds[4];
        int count = kinds_of(rows, i, &row, kinds);
        if (count)
            turn(v, row.second);
        for (int kind = 0; kind < count; kind++)
            count_kind(v, &row, kinds[kind], i < trained);
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
