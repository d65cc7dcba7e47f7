/* A serialized p4.v1.DigestList as rows of fixed width: one big-endian number a member, as rows.py lays them out.
 *
 *   DigestList    digest_id = 1, list_id = 2, data = 3 (repeated), timestamp = 4
 *   P4Data        bitstring = 1, struct = 5, other kinds of data
 *   P4StructLike  members = 1 (repeated P4Data)
 *
 * Every read is checked against the end of its message; unknown fields are skipped, as protobuf does.
 */

#include <stdint.h>
#include <string.h>

typedef struct {
    const uint8_t *at, *end;
} Span;

static int varint(Span *s, uint64_t *value) {
    *value = 0;
    for (int shift = 0; shift < 70 && s->at < s->end; shift += 7) {
        uint8_t byte = *s->at++;
        if (shift < 64) *value |= (uint64_t)(byte & 0x7F) << shift;
        if (byte < 0x80) return 1;
    }
    return 0;
}

static int bytes(Span *s, Span *inner) {
    uint64_t size;
    if (!varint(s, &size) || size > (uint64_t)(s->end - s->at)) return 0;
    *inner = (Span){s->at, s->at + size};
    s->at += size;
    return 1;
}

static int fixed(Span *s, long size) {
    if (s->end - s->at < size) return 0;
    s->at += size;
    return 1;
}

/* Steps over a field without looking at it; groups, which P4Runtime does not have, are refused. */
static int skip(Span *s, uint64_t tag) {
    uint64_t number;
    Span inner;
    switch (tag & 7) {
        case 0: return varint(s, &number);
        case 1: return fixed(s, 8);
        case 2: return bytes(s, &inner);
        case 5: return fixed(s, 4);
        default: return 0;
    }
}

/* A number as so many bytes, right-aligned; 0 if it does not fit. */
static int number(const uint8_t *at, long size, uint8_t *to, long width) {
    while (size && !*at) at++, size--;
    if (size > width) return 0;
    if (width > 8) {
        memset(to, 0, width - size);
        if (size) memcpy(to + width - size, at, size);
        return 1;
    }
    uint64_t value = 0;
    while (size--) value = value << 8 | *at++;
    for (long i = width; i--; value >>= 8) to[i] = (uint8_t)value;
    return 1;
}

/* A member as switches write it: a bitstring of less than 128 bytes and nothing else.  0 if it is written otherwise. */
static int usual_member(Span *all, const uint8_t **value, long *size) {
    const uint8_t *at = all->at;
    if (all->end - at < 4 || at[0] != (1 << 3 | 2) || at[2] != (1 << 3 | 2) || at[1] > 0x7F || at[3] + 2 != at[1])
        return 0;
    if (at[1] > all->end - at - 2) return 0;
    *value = at + 4;
    *size = at[3];
    all->at = at + 4 + at[3];
    return 1;
}

/* The value of one member, right-aligned; 0 if it is damaged or does not fit. */
static int member(Span s, uint8_t *to, long width) {
    Span value = {0, 0};
    uint64_t tag;
    while (s.at < s.end) {
        if (!varint(&s, &tag)) return 0;
        if (tag == (1 << 3 | 2)) {
            if (!bytes(&s, &value)) return 0;
        } else {
            if (tag >> 3 <= 12) value.at = value.end; /* another kind of data replaces it */
            if (!skip(&s, tag)) return 0;
        }
    }
    return number(value.at, value.end - value.at, to, width);
}

static int row(Span s, const int32_t *widths, long fields, uint8_t *to) {
    Span all = {0, 0}, one;
    uint64_t tag;
    long found = 0;
    while (s.at < s.end) {
        if (!varint(&s, &tag)) return 0;
        if (tag == (5 << 3 | 2)) {
            if (!bytes(&s, &all)) return 0;
        } else if (!skip(&s, tag)) {
            return 0;
        }
    }
    while (all.at < all.end) {
        const uint8_t *value;
        long size;
        if (found < fields && usual_member(&all, &value, &size)) {
            if (!number(value, size, to, widths[found])) return 0;
            to += widths[found++];
            continue;
        }
        if (!varint(&all, &tag)) return 0;
        if (tag != (1 << 3 | 2)) {
            if (!skip(&all, tag)) return 0;
            continue;
        }
        if (found == fields || !bytes(&all, &one) || !member(one, to, widths[found])) return 0;
        to += widths[found++];
    }
    return found == fields;
}

/* Samples of a list, sound or not; -1 where the list itself is damaged. */
long digest_samples(const uint8_t *data, long size) {
    Span s = {data, data + size};
    uint64_t tag;
    long count = 0;
    while (s.at < s.end) {
        if (!varint(&s, &tag) || !skip(&s, tag)) return -1;
        count += tag == (3 << 3 | 2);
    }
    return count;
}

/* Writes the rows of sound samples, at most `room`; returns how many. */
long digest_rows(const uint8_t *data, long size, const int32_t *widths, long fields, long row_bytes,
                 uint8_t *rows, long room) {
    Span s = {data, data + size}, one;
    uint64_t tag;
    long count = 0;
    while (s.at < s.end && count < room) {
        if (!varint(&s, &tag)) break;
        if (tag != (3 << 3 | 2)) {
            if (!skip(&s, tag)) break;
            continue;
        }
        if (!bytes(&s, &one)) break;
        count += row(one, widths, fields, rows + count * row_bytes);
    }
    return count;
}

/* ---- rows of the program's frame digest as packet records: `digest_in.py` in C */

typedef struct {
    int32_t at, width;
} Field;

/* Fields in the order of `digest_columns.FIELDS`. */
enum {
    TIMESTAMP, ARRIVAL, SEQUENCE, INGRESS_PORT, VID, ETHERTYPE, LENGTH, ETH_SRC, ETH_DST, SRC_HI, SRC_LO, DST_HI, DST_LO,
    PROTOCOL, FRAGMENT, L4_VALID, QUOTED, QUOTED_PROTOCOL, SPORT, DPORT, TCP_FLAGS, TCP_SEQUENCE, TCP_ACKNOWLEDGEMENT,
    ICMP_TYPE, ICMP_CODE, ARP_OPERATION, ARP_SENDER_MAC, ARP_TARGET_MAC, FIELDS
};

enum { ARP = 0x0806, IPV4 = 0x0800, IPV6 = 0x86DD, SECOND_TAG = 0x9100, LEAST_ETHERTYPE = 0x600, LATER_FRAGMENT = 2 };
enum { ICMP = 1, TCP = 6, UDP = 17, ICMP6 = 58 };

static uint64_t get(const uint8_t *row, Field field) {
    const uint8_t *at = row + field.at;
    uint16_t two;
    uint32_t four;
    uint64_t eight;
    switch (field.width) {
        case 1: return *at;
        case 2: memcpy(&two, at, 2); return __builtin_bswap16(two);
        case 4: memcpy(&four, at, 4); return __builtin_bswap32(four);
        default: memcpy(&eight, at, 8); return __builtin_bswap64(eight);
    }
}

/* Where a column of numbers of so many bytes begins; the next one begins at a multiple of 16. */
static uint8_t *column(uint8_t **to, long n, long size) {
    uint8_t *begin = *to;
    *to += (n * size + 15) & ~15L;
    return begin;
}

typedef struct {
    uint64_t *sequence, *arrival, *eth_src, *eth_dst, *arp_src_mac, *arp_dst_mac, *src_hi, *src_lo, *dst_hi, *dst_lo;
    int64_t *time_us;
    uint32_t *length, *arp_src_ip, *arp_dst_ip, *tcp_seq, *tcp_ack;
    int32_t *vlan, *arp_op, *ip_proto, *tcp_sport, *tcp_dport, *udp_sport, *udp_dport, *icmp_type, *icmp_code, *icmp6_type,
        *icmp6_code;
    uint16_t *port, *eth_type;
    uint8_t *ip_version, *quoted, *tcp_flags, *covered;
} Columns;

/* In the order of `PACKET_COLUMNS`. */
static Columns columns_at(uint8_t *to, long n) {
    Columns c;
#define COLUMN(name) c.name = (void *)column(&to, n, sizeof *c.name)
    COLUMN(sequence); COLUMN(arrival); COLUMN(time_us); COLUMN(port); COLUMN(length);
    COLUMN(eth_src); COLUMN(eth_dst); COLUMN(eth_type); COLUMN(vlan);
    COLUMN(arp_op); COLUMN(arp_src_mac); COLUMN(arp_src_ip); COLUMN(arp_dst_mac); COLUMN(arp_dst_ip);
    COLUMN(ip_version); COLUMN(src_hi); COLUMN(src_lo); COLUMN(dst_hi); COLUMN(dst_lo); COLUMN(ip_proto);
    COLUMN(tcp_sport); COLUMN(tcp_dport); COLUMN(udp_sport); COLUMN(udp_dport); COLUMN(quoted);
    COLUMN(tcp_flags); COLUMN(tcp_seq); COLUMN(tcp_ack);
    COLUMN(icmp_type); COLUMN(icmp_code); COLUMN(icmp6_type); COLUMN(icmp6_code);
    COLUMN(covered);
#undef COLUMN
    return c;
}

static void read_arp(const Columns *c, long i, const uint8_t *row, const Field *field, int is_arp) {
    uint64_t operation = get(row, field[ARP_OPERATION]);
    int read = is_arp && operation;
    c->arp_op[i] = read ? (int32_t)operation : -1;
    c->arp_src_mac[i] = read ? get(row, field[ARP_SENDER_MAC]) : 0;
    c->arp_src_ip[i] = read ? (uint32_t)get(row, field[SRC_LO]) : 0;
    c->arp_dst_mac[i] = read ? get(row, field[ARP_TARGET_MAC]) : 0;
    c->arp_dst_ip[i] = read ? (uint32_t)get(row, field[DST_LO]) : 0;
}

static void read_transport(const Columns *c, long i, const uint8_t *row, const Field *field, int ip) {
    uint64_t protocol = get(row, field[PROTOCOL]), quoted_protocol = get(row, field[QUOTED_PROTOCOL]);
    int own = ip && get(row, field[L4_VALID]) == 1, quoted = ip && get(row, field[QUOTED]) == 1;
    int tcp = own && protocol == TCP, icmp = own && protocol == ICMP, icmp6 = own && protocol == ICMP6;
    int tcp_ports = tcp || (quoted && quoted_protocol == TCP);
    int udp_ports = (own && protocol == UDP) || (quoted && quoted_protocol == UDP);
    int32_t sport = (int32_t)get(row, field[SPORT]), dport = (int32_t)get(row, field[DPORT]);
    int32_t type = (int32_t)get(row, field[ICMP_TYPE]), code = (int32_t)get(row, field[ICMP_CODE]);
    c->tcp_sport[i] = tcp_ports ? sport : -1;
    c->tcp_dport[i] = tcp_ports ? dport : -1;
    c->udp_sport[i] = udp_ports ? sport : -1;
    c->udp_dport[i] = udp_ports ? dport : -1;
    c->quoted[i] = quoted && (tcp_ports || udp_ports);
    c->tcp_flags[i] = tcp ? (uint8_t)get(row, field[TCP_FLAGS]) : 0;
    c->tcp_seq[i] = tcp ? (uint32_t)get(row, field[TCP_SEQUENCE]) : 0;
    c->tcp_ack[i] = tcp ? (uint32_t)get(row, field[TCP_ACKNOWLEDGEMENT]) : 0;
    c->icmp_type[i] = icmp ? type : -1;
    c->icmp_code[i] = icmp ? code : -1;
    c->icmp6_type[i] = icmp6 ? type : -1;
    c->icmp6_code[i] = icmp6 ? code : -1;
}

/* Whether the digest has all fields that the frame would give: `coverage.py`. */
static int is_covered(const uint8_t *row, const Field *field, uint64_t ethertype) {
    int four = ethertype == IPV4, six = ethertype == IPV6;
    uint64_t protocol = get(row, field[PROTOCOL]);
    int unread = (four || six) && !get(row, field[L4_VALID]) && !(get(row, field[FRAGMENT]) & LATER_FRAGMENT);
    int icmp = (four && protocol == ICMP) || (six && protocol == ICMP6);
    return !(ethertype < LEAST_ETHERTYPE || ethertype == SECOND_TAG || unread || (icmp && !get(row, field[SPORT])));
}

static void read_row(const Columns *c, long i, const uint8_t *row, const Field *field, int64_t base_us) {
    uint64_t ethertype = get(row, field[ETHERTYPE]), vid = get(row, field[VID]);
    int four = ethertype == IPV4, six = ethertype == IPV6, ip = four || six;
    c->sequence[i] = get(row, field[SEQUENCE]);
    c->arrival[i] = get(row, field[ARRIVAL]);
    c->time_us[i] = (int64_t)get(row, field[TIMESTAMP]) + base_us;
    c->port[i] = (uint16_t)get(row, field[INGRESS_PORT]);
    c->length[i] = (uint32_t)get(row, field[LENGTH]);
    c->eth_src[i] = get(row, field[ETH_SRC]);
    c->eth_dst[i] = get(row, field[ETH_DST]);
    c->eth_type[i] = ethertype >= LEAST_ETHERTYPE ? (uint16_t)ethertype : 0;
    c->vlan[i] = vid ? (int32_t)vid : -1;
    c->ip_version[i] = four ? 4 : six ? 6 : 0;
    c->src_hi[i] = ip ? get(row, field[SRC_HI]) : 0;
    c->src_lo[i] = ip ? get(row, field[SRC_LO]) : 0;
    c->dst_hi[i] = ip ? get(row, field[DST_HI]) : 0;
    c->dst_lo[i] = ip ? get(row, field[DST_LO]) : 0;
    c->ip_proto[i] = ip ? (int32_t)get(row, field[PROTOCOL]) : -1;
    c->covered[i] = (uint8_t)is_covered(row, field, ethertype);
    read_arp(c, i, row, field, ethertype == ARP);
    read_transport(c, i, row, field, ip);
}

/* Columns of n rows, one behind the other in the order of `PACKET_COLUMNS`, each at a multiple of 16 bytes; behind them
 * which rows are covered.  The fields lie within a row, and have 1, 2, 4 or 8 bytes. */
void digest_columns(const uint8_t *rows, long n, long row_bytes, const Field *fields, int64_t base_us, uint8_t *to) {
    Field field[FIELDS]; /* which no column can overwrite */
    memcpy(field, fields, sizeof field);
    Columns c = columns_at(to, n);
    for (long i = 0; i < n; i++) read_row(&c, i, rows + i * row_bytes, field, base_us);
}
