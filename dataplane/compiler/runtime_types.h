/* What generated programs are written in: wide integers, bit strings, hashes, meters, tables.
 *
 * Wide integers are two's complement in 64-bit limbs, lowest first: W4 has 256 bits, W8 has 512.
 * The file is compiled together with the generated code as one unit, so that all of it can be inlined.
 */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef uint8_t u8;
typedef uint16_t u16;
typedef uint32_t u32;
typedef uint64_t u64;
typedef int64_t i64;
typedef unsigned __int128 u128;
typedef __int128 i128;

#define INLINE static inline __attribute__((always_inline, unused))
#define PLAIN static __attribute__((unused))

enum { OUT_PORT = 1, OUT_CPU, OUT_DIGEST }; /* kinds of records in the output */

/* -- wide integers ------------------------------------------------------------------------------- */

#define WIDE(N, T)                                                                                     \
    typedef struct { u64 w[N]; } T;                                                                    \
    INLINE T T##_u64(u64 x) { T r = {{x}}; return r; }                                                 \
    INLINE T T##_s64(u64 x) { T r; r.w[0] = x; for (int i = 1; i < N; i++) r.w[i] = -(x >> 63); return r; } \
    INLINE T T##_u128(u128 x) { T r = {{(u64)x, (u64)(x >> 64)}}; return r; }                          \
    INLINE T T##_s128(u128 x) { u64 s = -(u64)(x >> 127); T r; r.w[0] = (u64)x; r.w[1] = (u64)(x >> 64); \
        for (int i = 2; i < N; i++) r.w[i] = s; return r; }                                            \
    INLINE T T##_load(const u64 *p, int n) { T r; for (int i = 0; i < N; i++) r.w[i] = i < n ? p[i] : 0; return r; } \
    INLINE void T##_save(u64 *p, T x, int n) { for (int i = 0; i < n; i++) p[i] = x.w[i]; }            \
    INLINE u128 T##_to128(T x) { return (u128)x.w[1] << 64 | x.w[0]; }                                 \
    INLINE T T##_and(T a, T b) { for (int i = 0; i < N; i++) a.w[i] &= b.w[i]; return a; }             \
    INLINE T T##_or(T a, T b) { for (int i = 0; i < N; i++) a.w[i] |= b.w[i]; return a; }              \
    INLINE T T##_xor(T a, T b) { for (int i = 0; i < N; i++) a.w[i] ^= b.w[i]; return a; }             \
    INLINE T T##_not(T a) { for (int i = 0; i < N; i++) a.w[i] = ~a.w[i]; return a; }                  \
    INLINE T T##_add(T a, T b) { u64 c = 0; for (int i = 0; i < N; i++) {                              \
        u128 s = (u128)a.w[i] + b.w[i] + c; a.w[i] = (u64)s; c = (u64)(s >> 64); } return a; }         \
    INLINE T T##_sub(T a, T b) { u64 c = 0; for (int i = 0; i < N; i++) {                              \
        u128 s = (u128)a.w[i] - b.w[i] - c; a.w[i] = (u64)s; c = (u64)(s >> 64) & 1; } return a; }     \
    PLAIN T T##_mul(T a, T b) { T r; memset(&r, 0, sizeof r); for (int i = 0; i < N; i++) { u64 c = 0; \
        for (int j = 0; i + j < N; j++) { u128 s = (u128)a.w[i] * b.w[j] + r.w[i + j] + c;             \
            r.w[i + j] = (u64)s; c = (u64)(s >> 64); } } return r; }                                   \
    INLINE u64 T##_limb(const T *a, unsigned i, u64 fill) { return i < N ? a->w[i] : fill; }           \
    INLINE u64 T##_bits64(const T *a, u64 n, u64 fill) { if (n >= 64 * N) return fill;                 \
        unsigned q = (unsigned)(n / 64), s = (unsigned)(n % 64); u64 r = T##_limb(a, q, fill) >> s;    \
        return s ? r | T##_limb(a, q + 1, fill) << (64 - s) : r; }                                     \
    INLINE u128 T##_bits128(const T *a, u64 n, u64 fill) {                                             \
        return (u128)T##_bits64(a, n + 64, fill) << 64 | T##_bits64(a, n, fill); }                     \
    INLINE T T##_fill_shr(T a, u64 n, u64 fill) { T r; for (int i = 0; i < N; i++)                     \
        r.w[i] = T##_bits64(&a, n + 64 * (u64)i, fill); return r; }                                    \
    INLINE T T##_shr(T a, u64 n) { return T##_fill_shr(a, n < 64 * N ? n : 64 * N, 0); }               \
    INLINE T T##_sar(T a, u64 n) { return T##_fill_shr(a, n < 64 * N ? n : 64 * N, -(a.w[N - 1] >> 63)); } \
    INLINE T T##_shl(T a, u64 n) { T r; unsigned q = (unsigned)(n < 64 * N ? n / 64 : N), s = n % 64;  \
        for (int i = 0; i < N; i++) { int j = i - (int)q; u64 v = j >= 0 ? a.w[j] << s : 0;            \
            if (s && j >= 1) v |= a.w[j - 1] >> (64 - s); r.w[i] = v; } return r; }                    \
    INLINE int T##_eq(T a, T b) { u64 d = 0; for (int i = 0; i < N; i++) d |= a.w[i] ^ b.w[i]; return d == 0; } \
    INLINE int T##_nz(T a) { u64 d = 0; for (int i = 0; i < N; i++) d |= a.w[i]; return d != 0; }      \
    INLINE int T##_lt(T a, T b) { for (int i = N - 1; i >= 0; i--) if (a.w[i] != b.w[i]) return a.w[i] < b.w[i]; \
        return 0; }                                                                                    \
    INLINE int T##_slt(T a, T b) { a.w[N - 1] ^= 1ull << 63; b.w[N - 1] ^= 1ull << 63; return T##_lt(a, b); } \
    INLINE T T##_sx(T a, unsigned n) { return T##_sar(T##_shl(a, 64 * N - n), 64 * N - n); }

WIDE(4, W4)
WIDE(8, W8)
INLINE W8 W8_W4(W4 x) { W8 r = {{x.w[0], x.w[1], x.w[2], x.w[3]}}; return r; }
INLINE W8 W8_sW4(W4 x) { u64 s = -(x.w[3] >> 63); W8 r = {{x.w[0], x.w[1], x.w[2], x.w[3], s, s, s, s}}; return r; }
INLINE W4 W4_W8(W8 x) { W4 r = {{x.w[0], x.w[1], x.w[2], x.w[3]}}; return r; }

INLINE u64 shl64(u64 x, u64 n) { return n < 64 ? x << n : 0; }
INLINE u64 shr64(u64 x, u64 n) { return n < 64 ? x >> n : 0; }
INLINE u64 sar64(u64 x, u64 n) { return (u64)((i64)x >> (n < 64 ? n : 63)); }
INLINE u128 shl128(u128 x, u64 n) { return n < 128 ? x << n : 0; }
INLINE u128 shr128(u128 x, u64 n) { return n < 128 ? x >> n : 0; }
INLINE u128 sar128(u128 x, u64 n) { return (u128)((i128)x >> (n < 128 ? n : 127)); }
INLINE u64 sx64(u64 x, unsigned n) { return (u64)((i64)(x << (64 - n)) >> (64 - n)); }
INLINE u128 sx128(u128 x, unsigned n) { return (u128)((i128)(x << (128 - n)) >> (128 - n)); }
INLINE u64 usat64(u64 x, u64 most) { return x > most ? most : x; }
INLINE u128 usat128(u128 x, u128 most) { return x > most ? most : x; }
INLINE u64 ssat64(u64 x, i64 least, i64 most) { return (u64)((i64)x < least ? least : (i64)x > most ? most : (i64)x); }
INLINE u128 ssat128(u128 x, i128 least, i128 most) {
    return (u128)((i128)x < least ? least : (i128)x > most ? most : (i128)x);
}

/* -- bytes --------------------------------------------------------------------------------------- */

INLINE u64 be1(const u8 *r) { return r[0]; }
INLINE u64 be2(const u8 *r) { u16 x; memcpy(&x, r, 2); return __builtin_bswap16(x); }
INLINE u64 be3(const u8 *r) { return be2(r) << 8 | r[2]; }
INLINE u64 be4(const u8 *r) { u32 x; memcpy(&x, r, 4); return __builtin_bswap32(x); }
INLINE u64 be5(const u8 *r) { return be4(r) << 8 | r[4]; }
INLINE u64 be6(const u8 *r) { return be4(r) << 16 | be2(r + 4); }
INLINE u64 be7(const u8 *r) { return be4(r) << 24 | be3(r + 4); }
INLINE u64 be8(const u8 *r) { u64 x; memcpy(&x, r, 8); return __builtin_bswap64(x); }
INLINE u128 be16(const u8 *r) { return (u128)be8(r) << 64 | be8(r + 8); }

INLINE void put2(u8 *r, u64 v) { u16 x = __builtin_bswap16((u16)v); memcpy(r, &x, 2); }
INLINE void put4(u8 *r, u64 v) { u32 x = __builtin_bswap32((u32)v); memcpy(r, &x, 4); }
INLINE void put6(u8 *r, u64 v) { put2(r, v >> 32); put4(r + 2, v); }
INLINE void put8(u8 *r, u64 v) { u64 x = __builtin_bswap64(v); memcpy(r, &x, 8); }
INLINE void put16(u8 *r, u128 v) { put8(r, (u64)(v >> 64)); put8(r + 8, (u64)v); }

/* `width` bits at bit `at` of a bit string, most significant first */
PLAIN W8 bits_get(const u8 *r, u64 at, unsigned width) {
    W8 v;
    memset(&v, 0, sizeof v);
    for (unsigned i = 0; i < width; i++) {
        u64 bit = at + width - 1 - i;
        v.w[i / 64] |= (u64)(r[bit / 8] >> (7 - bit % 8) & 1) << (i % 64);
    }
    return v;
}
PLAIN void bits_put(u8 *r, u64 at, unsigned width, const u64 *v) {
    unsigned i = 0;
    while (i < width) {
        u64 bit = at + width - 1 - i;
        unsigned room = (unsigned)(bit % 8) + 1, shift = 8 - room, take = width - i < room ? width - i : room;
        u64 part = v[i / 64] >> (i % 64);
        if (i % 64 + take > 64) part |= v[i / 64 + 1] << (64 - i % 64);
        u8 mask = (u8)(((1u << take) - 1) << shift);
        r[bit / 8] = (u8)((r[bit / 8] & ~mask) | ((u8)(part << shift) & mask));
        i += take;
    }
}
INLINE void bits_put64(u8 *r, u64 at, unsigned width, u64 v) { bits_put(r, at, width, &v); }
INLINE void bits_put128(u8 *r, u64 at, unsigned width, u128 v) {
    u64 w[2] = {(u64)v, (u64)(v >> 64)};
    bits_put(r, at, width, w);
}
INLINE void bits_put256(u8 *r, u64 at, unsigned width, W4 v) { bits_put(r, at, width, v.w); }
INLINE void bits_put512(u8 *r, u64 at, unsigned width, W8 v) { bits_put(r, at, width, v.w); }
INLINE u64 bits_get64(const u8 *r, u64 at, unsigned width) { return bits_get(r, at, width).w[0]; }
INLINE u128 bits_get128(const u8 *r, u64 at, unsigned width) { return W8_to128(bits_get(r, at, width)); }
INLINE W4 bits_get256(const u8 *r, u64 at, unsigned width) { return W4_W8(bits_get(r, at, width)); }
INLINE W8 bits_get512(const u8 *r, u64 at, unsigned width) { return bits_get(r, at, width); }

/* -- hashes -------------------------------------------------------------------------------------- */

static u32 crc32_table[8][256];
static u16 crc16_table[256], ccitt_table[256];

static void hashes_start(void) {
    for (u32 i = 0; i < 256; i++) {
        u32 a = i, b = i, c = i << 8;
        for (int k = 0; k < 8; k++) {
            a = a & 1 ? a >> 1 ^ 0xEDB88320u : a >> 1;
            b = b & 1 ? b >> 1 ^ 0xA001u : b >> 1;
            c = c & 0x8000 ? c << 1 ^ 0x1021u : c << 1;
        }
        crc32_table[0][i] = a;
        crc16_table[i] = (u16)b;
        ccitt_table[i] = (u16)c;
    }
    for (int t = 1; t < 8; t++)
        for (int i = 0; i < 256; i++)
            crc32_table[t][i] = crc32_table[t - 1][i] >> 8 ^ crc32_table[0][crc32_table[t - 1][i] & 255];
}

PLAIN u64 hash_crc32(const u8 *d, u64 n) {
    u32 c = 0xFFFFFFFFu;
    while (n >= 8) {
        u64 x;
        memcpy(&x, d, 8);
        x ^= c;
        c = crc32_table[7][x & 255] ^ crc32_table[6][x >> 8 & 255] ^ crc32_table[5][x >> 16 & 255] ^
            crc32_table[4][x >> 24 & 255] ^ crc32_table[3][x >> 32 & 255] ^ crc32_table[2][x >> 40 & 255] ^
            crc32_table[1][x >> 48 & 255] ^ crc32_table[0][x >> 56];
        d += 8;
        n -= 8;
    }
    while (n--) c = c >> 8 ^ crc32_table[0][(c ^ *d++) & 255];
    return c ^ 0xFFFFFFFFu;
}
PLAIN u64 hash_crc32_custom(const u8 *d, u64 n) { return hash_crc32(d, n); }
PLAIN u64 hash_crc16(const u8 *d, u64 n) {
    u16 c = 0;
    while (n--) c = (u16)(c >> 8 ^ crc16_table[(c ^ *d++) & 255]);
    return c;
}
PLAIN u64 hash_crc16_custom(const u8 *d, u64 n) { return hash_crc16(d, n); }
PLAIN u64 hash_crcCCITT(const u8 *d, u64 n) {
    u16 c = 0xFFFF;
    while (n--) c = (u16)(c << 8 ^ ccitt_table[(c >> 8 ^ *d++) & 255]);
    return c;
}
PLAIN u64 hash_csum16(const u8 *d, u64 n) {
    u64 sum = 0;
    while (n >= 2) { sum += be2(d); d += 2; n -= 2; }
    if (n) sum += (u64)*d << 8;
    while (sum >> 16) sum = (sum & 0xFFFF) + (sum >> 16);
    return ~sum & 0xFFFF;
}
PLAIN u64 hash_cksum16(const u8 *d, u64 n) { return hash_csum16(d, n); }
PLAIN u64 hash_identity(const u8 *d, u64 n) {
    u64 v = 0;
    for (u64 i = 0; i < 8 && i < n; i++) v = v << 8 | d[i];
    return v;
}
PLAIN u64 hash_xor(const u8 *d, u64 n, unsigned size) {
    u64 v = 0;
    for (u64 i = 0; i < n; i++) v ^= (u64)d[i] << (8 * (size - 1 - i % size));
    return v;
}
PLAIN u64 hash_xor16(const u8 *d, u64 n) { return hash_xor(d, n, 2); }
PLAIN u64 hash_xor32(const u8 *d, u64 n) { return hash_xor(d, n, 4); }

/* -- meters -------------------------------------------------------------------------------------- */

typedef struct {
    u64 rate[2], burst[2], tokens[2], last[2]; /* 0 committed, 1 peak */
    u8 on;
} meter;

PLAIN void meter_set(meter *m, const u64 *rates) {
    memset(m, 0, sizeof *m);
    if (!rates) return;
    m->on = 1;
    for (int i = 0; i < 2; i++) {
        m->rate[i] = rates[2 * i];
        m->burst[i] = m->tokens[i] = rates[2 * i + 1];
    }
}
PLAIN int meter_take(meter *m, int i, u64 cost, u64 now) {
    u64 gained = (u64)((u128)now * m->rate[i] / 1000000);
    if (gained > m->last[i]) {
        u64 more = gained - m->last[i], room = m->burst[i] - m->tokens[i];
        m->tokens[i] += more < room ? more : room;
    }
    m->last[i] = gained;
    if (m->tokens[i] < cost) return 0;
    m->tokens[i] -= cost;
    return 1;
}
PLAIN u64 meter_run(meter *m, u64 cost, u64 now) {
    if (!m->on) return 0;
    if (!meter_take(m, 1, cost, now)) return 2;
    return meter_take(m, 0, cost, now) ? 0 : 1;
}

/* -- tables: tuple-space search -------------------------------------------------------------------
 * Entries with one mask form a group: a hash table of chains, each chain best first.  Groups are asked in
 * the order of their best entry, and no further than an entry that no later group can beat.
 * Nearly all frames match no entry of a big table.  A Bloom filter with one hash, 8 bits for each chain, says
 * so out of the nearest cache; without it every other frame would fetch an entry to compare with.
 */

#define NONE 0xFFFFFFFFu

typedef struct { u32 word, shift; u64 mask, low, high; } range_part;

typedef struct {
    u64 packets, bytes, hit;
    i64 order; /* smaller wins: -rank, then slot */
    i64 action;
    u32 next, group, ranges, used;
    range_part *range;
    meter *meter;
} entry;

typedef struct {
    i64 best;
    u64 *seen; /* the filter: 8 * size bits; those of removed entries stay until it is made again */
    u32 *heads, size, count, used, place, removed;
    /* the key words that this mask looks at, and the bits of them in which all entries agree */
    u32 n, at[KEY_WORDS];
    u64 mask[KEY_WORDS], agreed[KEY_WORDS], value[KEY_WORDS];
} group;

/* a group in the order of search, with its most telling word: most lookups end here */
typedef struct {
    i64 best;
    u64 agreed, value;
    u32 at, group;
} probe;

typedef struct {
    u32 words, stride, slots, groups, group_room, listed, metered;
    entry *entries;
    u64 *keys, *params, *default_params;
    i64 default_action;
    group *group;
    probe *list;
} table;

INLINE u64 key_hash(const u64 *k, const group *g) {
    u64 h = 0x9E3779B97F4A7C15ull;
    for (u32 i = 0; i < g->n; i++) {
        h = (h ^ (k[g->at[i]] & g->mask[i])) * 0xD6E8FEB86659FD93ull;
        h ^= h >> 32;
    }
    return h;
}

/* the bit of a hash in the filter: not of those that choose the chain */
INLINE u64 seen_bit(u64 hash, const group *g) { return hash >> 32 & (8ull * g->size - 1); }

/* could any entry of the group have these bits? */
INLINE int group_may(const group *g, const u64 *k) {
    u64 d = 0;
    for (u32 i = 0; i < g->n; i++) d |= (k[g->at[i]] ^ g->value[i]) & g->agreed[i];
    return !d;
}

INLINE int in_ranges(const entry *e, const u64 *k) {
    for (u32 i = 0; i < e->ranges; i++) {
        const range_part *r = &e->range[i];
        u64 v = k[r->word] >> r->shift & r->mask;
        if (v < r->low || v > r->high) return 0;
    }
    return 1;
}

INLINE entry *table_find(const table *t, const u64 *k, u32 words) {
    entry *found = 0;
    for (u32 i = 0; i < t->listed; i++) {
        const probe *p = &t->list[i];
        if ((k[p->at] ^ p->value) & p->agreed) continue;
        if (found && p->best > found->order) break;
        const group *g = &t->group[p->group];
        if (!group_may(g, k)) continue;
        u64 hash = key_hash(k, g), bit = seen_bit(hash, g);
        if (!(g->seen[bit / 64] >> bit % 64 & 1)) continue;
        u32 at = g->heads[hash & (g->size - 1)];
        for (; at != NONE; at = t->entries[at].next) {
            entry *e = &t->entries[at];
            if (found && e->order > found->order) break;
            const u64 *v = t->keys + (u64)at * words;
            u64 difference = 0;
            for (u32 w = 0; w < g->n; w++) difference |= (k[g->at[w]] & g->mask[w]) ^ v[g->at[w]];
            if (!difference && in_ranges(e, k)) {
                found = e;
                break;
            }
        }
    }
    return found;
}

static void table_grow(table *t, u32 slot) {
    u32 slots = t->slots ? t->slots : 16;
    while (slots <= slot) slots *= 2;
    if (slots == t->slots) return;
    t->entries = realloc(t->entries, slots * sizeof(entry));
    memset(t->entries + t->slots, 0, (slots - t->slots) * sizeof(entry));
    t->keys = realloc(t->keys, (u64)slots * t->words * 8 + 8);
    t->params = realloc(t->params, (u64)slots * t->stride * 8 + 8);
    t->slots = slots;
}

static void group_link(table *t, group *g, u32 slot) {
    entry *e = &t->entries[slot];
    u64 hash = key_hash(t->keys + (u64)slot * t->words, g), bit = seen_bit(hash, g);
    g->seen[bit / 64] |= 1ull << bit % 64;
    u32 *at = &g->heads[hash & (g->size - 1)];
    while (*at != NONE && t->entries[*at].order < e->order) at = &t->entries[*at].next;
    e->next = *at;
    *at = slot;
}

static void group_resize(table *t, u32 number, u32 size) {
    group *g = &t->group[number];
    g->heads = realloc(g->heads, size * sizeof(u32));
    g->seen = realloc(g->seen, size);
    memset(g->seen, 0, size);
    g->size = size;
    g->removed = 0;
    for (u32 i = 0; i < size; i++) g->heads[i] = NONE;
    for (u32 slot = 0; slot < t->slots; slot++)
        if (t->entries[slot].used && t->entries[slot].group == number) group_link(t, g, slot);
}

static void probe_set(table *t, u32 number) {
    group *g = &t->group[number];
    probe *p = &t->list[g->place];
    *p = (probe){g->best, 0, 0, 0, number};
    int most = -1;
    for (u32 i = 0; i < g->n; i++) {
        /* zeros tell little: most words of most frames are zero there, as IPv4 in 128 bits */
        int bits = 64 * __builtin_popcountll(g->agreed[i] & g->value[i]) + __builtin_popcountll(g->agreed[i]);
        if (bits <= most) continue;
        most = bits;
        p->agreed = g->agreed[i];
        p->value = g->value[i];
        p->at = g->at[i];
    }
}

static void table_list(table *t) {
    u32 n = 0;
    t->list = realloc(t->list, (t->groups + 1) * sizeof(probe));
    for (u32 i = 0; i < t->groups; i++) {
        if (!t->group[i].used) continue;
        u32 j = n++;
        while (j && t->list[j - 1].best > t->group[i].best) { t->list[j] = t->list[j - 1]; j--; }
        t->list[j].best = t->group[i].best;
        t->list[j].group = i;
    }
    t->listed = n;
    for (u32 i = 0; i < n; i++) {
        t->group[t->list[i].group].place = i;
        probe_set(t, t->list[i].group);
    }
}

static int same_mask(const group *g, const u64 *mask, u32 words) {
    u32 j = 0;
    for (u32 i = 0; i < words; i++) {
        u64 own = j < g->n && g->at[j] == i ? g->mask[j++] : 0;
        if (own != mask[i]) return 0;
    }
    return 1;
}

static u32 table_group(table *t, const u64 *mask, const u64 *value) {
    u32 free = t->groups;
    for (u32 i = 0; i < t->groups; i++) {
        if (!t->group[i].used) free = i;
        else if (same_mask(&t->group[i], mask, t->words)) return i;
    }
    if (free == t->groups) {
        t->group = realloc(t->group, (t->groups + 1) * sizeof(group));
        memset(&t->group[t->groups++], 0, sizeof(group));
    }
    group *g = &t->group[free];
    g->used = 1;
    g->count = 0;
    g->best = INT64_MAX;
    g->n = 0;
    for (u32 i = 0; i < t->words; i++) {
        if (!mask[i]) continue;
        g->at[g->n] = i;
        g->mask[g->n] = g->agreed[g->n] = mask[i];
        g->value[g->n++] = value[i] & mask[i];
    }
    group_resize(t, free, 16);
    return free;
}

PLAIN void table_insert(table *t, u32 slot, const u64 *value, const u64 *mask, u32 ranges,
                        const range_part *range, u32 rank, i64 action, const char *params, u64 now) {
    table_grow(t, slot);
    entry *e = &t->entries[slot];
    meter *kept = e->meter;
    memset(e, 0, sizeof *e);
    e->meter = kept;
    if (t->metered) {
        if (!e->meter) e->meter = malloc(sizeof(meter));
        meter_set(e->meter, 0);
    }
    e->order = -((i64)rank << 32) + slot;
    e->action = action;
    e->hit = now;
    e->ranges = ranges;
    if (ranges) {
        e->range = malloc(ranges * sizeof(range_part));
        memcpy(e->range, range, ranges * sizeof(range_part));
    }
    for (u32 i = 0; i < t->words; i++) t->keys[(u64)slot * t->words + i] = value[i] & mask[i];
    memcpy(t->params + (u64)slot * t->stride, params, t->stride * 8);
    e->group = table_group(t, mask, value);
    e->used = 1;
    group *g = &t->group[e->group];
    for (u32 i = 0; i < g->n; i++) g->agreed[i] &= ~(value[g->at[i]] ^ g->value[i]);
    g->count++;
    if (g->count > g->size) group_resize(t, e->group, g->size * 4);
    else group_link(t, g, slot);
    if (e->order < g->best) {
        g->best = e->order;
        table_list(t);
    } else {
        probe_set(t, e->group);
    }
}

PLAIN void table_remove(table *t, u32 slot) {
    entry *e = &t->entries[slot];
    group *g = &t->group[e->group];
    u32 *at = &g->heads[key_hash(t->keys + (u64)slot * t->words, g) & (g->size - 1)];
    while (*at != slot) at = &t->entries[*at].next;
    *at = e->next;
    e->used = 0;
    free(e->range);
    e->range = 0;
    g->count--;
    if (!g->count) g->used = 0;
    else if (++g->removed > g->size) group_resize(t, e->group, g->size);
    /* a bound that is too good is still right: it only makes a search look here in vain */
    if (g->count && (e->order != g->best || g->size > 64)) return;
    g->best = INT64_MAX;
    for (u32 i = 0; g->count && i < g->size; i++)
        if (g->heads[i] != NONE && t->entries[g->heads[i]].order < g->best) g->best = t->entries[g->heads[i]].order;
    table_list(t);
}

PLAIN void table_free(table *t) {
    for (u32 i = 0; i < t->slots; i++) {
        if (t->entries[i].used) free(t->entries[i].range);
        free(t->entries[i].meter);
    }
    for (u32 i = 0; i < t->groups; i++) {
        free(t->group[i].heads);
        free(t->group[i].seen);
    }
    free(t->entries);
    free(t->keys);
    free(t->params);
    free(t->default_params);
    free(t->group);
    free(t->list);
}
