/* Packets as rows, with the meaning that `behaviour/rows.py` gives them, and what their keys are; blocks in force. */

#ifndef PACKET_ROWS_H
#define PACKET_ROWS_H

#include "hash_table.h"
#include <math.h>

#define ECHO (1LL << 24)
#define ARP (2LL << 24)
#define OTHER (3LL << 24)
#define FROM_UDP (4LL << 24)
#define STRAY_TCP (5LL << 24)
#define ANY_UDP (6LL << 24)
#define OPENING (7LL << 24) /* SYNs, as a kind of one-way traffic */
#define UNANSWERED (8LL << 24) /* echo requests without a reply, beside all of them */
#define TCP (6LL << 16)
#define UDP (17LL << 16)
#define FIN 0x01
#define SYN 0x02
#define RST 0x04
#define ACK 0x10
#define WELL_KNOWN 1024

/* Of no version: hi and lo are 0. */
typedef struct {
    uint64_t hi, lo;
    uint8_t version;
} Address;

/* Made of columns once for all trackers, by `rows_read`. */
typedef struct {
    double time;
    int64_t second;
    uint64_t arrival, mac, to_mac;
    Address source, target;
    int64_t service, reverse;
    int32_t sport, dport, udp_sport, udp_dport;
    uint32_t length;
    uint16_t port;
    uint8_t flags, is_arp, is_tcp, is_udp, is_ping, to_group, group, quoted, answer;
} Row;

static inline int is_six(Address address)
{
    return address.version == 6;
}

static inline int is_some(Address address)
{
    return is_six(address) || address.lo;
}

static inline int same_address(Address a, Address b)
{
    return a.hi == b.hi && a.lo == b.lo && is_six(a) == is_six(b);
}

static inline Address address_of(uint8_t version, uint64_t hi, uint64_t lo)
{
    Address found = {version == 6 ? hi : 0, version == 6 ? lo : version == 4 ? lo & 0xFFFFFFFFu : 0, version == 4 || version == 6 ? version : 0};
    return found;
}

/* A SYN-ACK or RST, which never begin a conversation. */
static inline int is_tcp_reply(uint8_t flags)
{
    return flags & RST || (flags & (SYN | ACK)) == (SYN | ACK);
}

static inline uint64_t join_ports(uint64_t low, uint64_t high)
{
    return (low & 0xFFFFFFFFu) | high << 32;
}

static inline Subject pair_of(uint64_t first, uint64_t second, Address source, Address target)
{
    Subject key = {{first, second, source.hi, source.lo, target.hi, target.lo}};
    return key;
}

static inline int comes_first(Address a, Address b)
{
    return a.hi != b.hi ? a.hi < b.hi : a.lo <= b.lo;
}

/* Both hosts of a packet, whichever sent it. */
static inline Subject hosts_of(const Row *row)
{
    int first = comes_first(row->source, row->target);
    return pair_of(is_six(row->source), 0, first ? row->source : row->target, first ? row->target : row->source);
}

/* Switch, port, MAC and address of who sends; `more` goes into the upper half of the second word. */
static inline Subject sender_of(uint16_t number, const Row *row, Address address, uint64_t more)
{
    Subject key = {{row->mac | (uint64_t)row->port << 48, number | (uint64_t)is_six(address) << 16 | more << 32, address.hi, address.lo, 0, 0}};
    return key;
}

/* ---- blocks in force: (switch, is_mac, version, address) */

#define ANY_SWITCH 0xFFFF

static Subject block_of(uint16_t number, int is_mac, uint8_t version, uint64_t hi, uint64_t lo)
{
    Subject key = {{number | (uint64_t)(is_mac != 0) << 16 | (uint64_t)version << 24, hi, lo, 0, 0, 0}};
    return key;
}

static int is_blocked(const Table *blocks, uint16_t number, uint64_t mac, Address address)
{
    if (!blocks->live)
        return 0;
    for (int any = 0; any < 2; any++) {
        uint16_t where = any ? ANY_SWITCH : number;
        Subject by_mac = block_of(where, 1, 0, 0, mac), by_ip = block_of(where, 0, address.version, address.hi, address.lo);
        if (table_find(blocks, &by_mac) != NONE || (address.version && table_find(blocks, &by_ip) != NONE))
            return 1;
    }
    return 0;
}

/* rows of number, is_mac, version, hi, lo; -1 when memory is short */
static int take_blocks(Table *blocks, const uint64_t *rows, long n)
{
    table_clear(blocks);
    for (long i = 0; i < n; i++, rows += 5) {
        Subject key = block_of((uint16_t)rows[0], (int)rows[1], (uint8_t)rows[2], rows[3], rows[4]);
        if (table_find(blocks, &key) == NONE && table_add(blocks, &key) == NONE)
            return -1;
    }
    return 0;
}

#endif
