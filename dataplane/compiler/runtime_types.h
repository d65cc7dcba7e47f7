/* What generated programs are written in: wide integers, bit strings, hashes, digests, meters.
 *
 * Wide integers are two's complement in 64-bit limbs, lowest first: W4 has 256 bits, W8 has 512.
 * The file is compiled together with the generated code as one unit, so that all of it can be inlined.
 */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

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

/* Shifts and slices have constant distances in most programs: unrolled, little is left of them. */
#define EACH(i, first, end) _Pragma("GCC unroll 8") for (int i = first; i < end; i++)

/* -- wide integers ------------------------------------------------------------------------------- */

#define WIDE(N, T)                                                                                     \
    typedef struct { u64 w[N]; } T;                                                                    \
    INLINE T T##_u64(u64 x) { T r = {{x}}; return r; }                                                 \
    INLINE T T##_s64(u64 x) { T r; r.w[0] = x; EACH(i, 1, N) r.w[i] = -(x >> 63); return r; }          \
    INLINE T T##_u128(u128 x) { T r = {{(u64)x, (u64)(x >> 64)}}; return r; }                          \
    INLINE T T##_s128(u128 x) { u64 s = -(u64)(x >> 127); T r; r.w[0] = (u64)x; r.w[1] = (u64)(x >> 64);\
        EACH(i, 2, N) r.w[i] = s; return r; }                                                          \
    INLINE T T##_load(const u64 *p, int n) { T r; EACH(i, 0, N) r.w[i] = i < n ? p[i] : 0; return r; } \
    INLINE void T##_save(u64 *p, T x, int n) { EACH(i, 0, n) p[i] = x.w[i]; }                          \
    INLINE u128 T##_to128(T x) { return (u128)x.w[1] << 64 | x.w[0]; }                                 \
    INLINE T T##_and(T a, T b) { EACH(i, 0, N) a.w[i] &= b.w[i]; return a; }                           \
    INLINE T T##_or(T a, T b) { EACH(i, 0, N) a.w[i] |= b.w[i]; return a; }                            \
    INLINE T T##_xor(T a, T b) { EACH(i, 0, N) a.w[i] ^= b.w[i]; return a; }                           \
    INLINE T T##_not(T a) { EACH(i, 0, N) a.w[i] = ~a.w[i]; return a; }                                \
    INLINE T T##_add(T a, T b) { u64 c = 0; EACH(i, 0, N) {                                            \
        u128 s = (u128)a.w[i] + b.w[i] + c; a.w[i] = (u64)s; c = (u64)(s >> 64); } return a; }         \
    INLINE T T##_sub(T a, T b) { u64 c = 0; EACH(i, 0, N) {                                            \
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
    INLINE T T##_fill_shr(T a, u64 n, u64 fill) { T r; EACH(i, 0, N)                                   \
        r.w[i] = T##_bits64(&a, n + 64 * (u64)i, fill); return r; }                                    \
    INLINE T T##_shr(T a, u64 n) { return T##_fill_shr(a, n < 64 * N ? n : 64 * N, 0); }               \
    INLINE T T##_sar(T a, u64 n) { return T##_fill_shr(a, n < 64 * N ? n : 64 * N, -(a.w[N - 1] >> 63)); }\
    INLINE T T##_shl(T a, u64 n) { T r; unsigned q = (unsigned)(n < 64 * N ? n / 64 : N), s = n % 64;  \
        EACH(i, 0, N) { int j = i - (int)q; u64 v = j >= 0 ? a.w[j] << s : 0;                          \
            if (s && j >= 1) v |= a.w[j - 1] >> (64 - s); r.w[i] = v; } return r; }                    \
    INLINE int T##_eq(T a, T b) { u64 d = 0; EACH(i, 0, N) d |= a.w[i] ^ b.w[i]; return d == 0; }      \
    INLINE int T##_nz(T a) { u64 d = 0; EACH(i, 0, N) d |= a.w[i]; return d != 0; }                    \
    INLINE int T##_lt(T a, T b) { _Pragma("GCC unroll 8") for (int i = N - 1; i >= 0; i--) if (a.w[i] != b.w[i]) return a.w[i] < b.w[i];\
        return 0; }                                                                                    \
    INLINE int T##_slt(T a, T b) { a.w[N - 1] ^= 1ull << 63; b.w[N - 1] ^= 1ull << 63; return T##_lt(a, b); }\
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

/* -- cells of registers --------------------------------------------------------------------------- */

#define LARGE_PAGE (2ull << 20)

INLINE u64 cells_size(u64 count) { return (8 * count + LARGE_PAGE - 1) & ~(LARGE_PAGE - 1); }

/* Zeros.  Large arrays get large pages where the kernel has them: cells are chosen by hashes, so that with small
 * pages most accesses would look up an address first.  Memory is used as far as it is touched. */
PLAIN u64 *cells_new(u64 count) {
    if (8 * count < LARGE_PAGE) return calloc(count, 8);
    u64 size = cells_size(count);
    u8 *from = mmap(0, size + LARGE_PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (from == MAP_FAILED) return 0;
    u64 before = -(u64)from & (LARGE_PAGE - 1);
    if (before) munmap(from, before);
    munmap(from + before + size, LARGE_PAGE - before);
#ifdef MADV_HUGEPAGE
    madvise(from + before, size, MADV_HUGEPAGE);
#endif
    return (u64 *)(from + before);
}
PLAIN void cells_free(u64 *cells, u64 count) {
    if (8 * count < LARGE_PAGE) free(cells);
    else if (cells) munmap(cells, cells_size(count));
}

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

INLINE u32 crc32_step(u64 x) {
    return crc32_table[7][x & 255] ^ crc32_table[6][x >> 8 & 255] ^ crc32_table[5][x >> 16 & 255] ^
           crc32_table[4][x >> 24 & 255] ^ crc32_table[3][x >> 32 & 255] ^ crc32_table[2][x >> 40 & 255] ^
           crc32_table[1][x >> 48 & 255] ^ crc32_table[0][x >> 56];
}
/* A start with all ones is one with zeros over data whose first four bytes are inverted, and zeros before those
 * change nothing then: with as many as fill the first eight bytes, no byte is left over at the end. */
PLAIN u64 hash_crc32(const u8 *d, u64 n) {
    u32 c = 0xFFFFFFFFu;
    if (n >= 8) {
        u64 x, fill = -n & 7;
        memcpy(&x, d, 8);
        u32 rest = fill > 4 ? 0xFFFFFFFFu >> 8 * (8 - fill) : 0;
        c = crc32_step((x ^ 0xFFFFFFFFu) << 8 * fill) ^ rest;
        d += 8 - fill;
        for (n -= 8 - fill; n; n -= 8, d += 8) {
            memcpy(&x, d, 8);
            c = crc32_step(x ^ c);
        }
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

/* -- digests ------------------------------------------------------------------------------------- */

/* A digest as samples.py has it: begun, its members one after the other, and ended.  The
 * head in front of the members holds their length; it has room for the longest that this digest may have. */
static u8 *varint(u8 *to, u64 value) {
    for (; value > 0x7F; value >>= 7) *to++ = (u8)(value | 0x80);
    *to++ = (u8)value;
    return to;
}
INLINE u32 varint_size(u64 value) { return value ? (70 - (u32)__builtin_clzll(value)) / 7 : 1; }

/* behind the last byte of a member, up to seven more may be written */
INLINE u8 *member_head(u8 *to, u32 size) {
    u32 head = 0x000A020A + 0x01000100 * size;
    memcpy(to, &head, 4);
    return to + 4;
}
INLINE u8 *member64(u8 *to, u64 x) {
    u32 size = (71 - (u32)__builtin_clzll(x | 1)) / 8;
    put8(member_head(to, size), x << 8 * (8 - size));
    return to + 4 + size;
}
INLINE u8 *member_wide(u8 *to, const u64 *w, u32 limbs) {
    while (limbs > 1 && !w[limbs - 1]) limbs--;
    u64 x = w[--limbs];
    u32 first = (71 - (u32)__builtin_clzll(x | 1)) / 8;
    to = member_head(to, first + 8 * limbs);
    put8(to, x << 8 * (8 - first));
    for (to += first; limbs--; to += 8) put8(to, w[limbs]);
    return to;
}

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
