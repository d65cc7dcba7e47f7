/* Packet columns, and the text keys that streams are found by. */

#ifndef AFTERIMAGE_KEYS_H
#define AFTERIMAGE_KEYS_H

#include <arpa/inet.h>
#include <stdint.h>
#include <string.h>

#define KEY_BYTES 80

typedef struct {
    const uint32_t *length;
    const double *time;
    const uint64_t *eth_src, *eth_dst;
    const int32_t *arp_op;
    const uint32_t *arp_src_ip, *arp_dst_ip;
    const uint8_t *ip_version;
    const uint64_t *ip_src_hi, *ip_src_lo, *ip_dst_hi, *ip_dst_lo;
    const int32_t *tcp_sport, *tcp_dport, *udp_sport, *udp_dport, *icmp_type;
} Columns;

#define COLUMNS (sizeof(Columns) / sizeof(void *))

typedef struct {
    uint8_t length;
    char text[KEY_BYTES - 1];
} Key;

/* The same text as published, so that what collides there collides here. */

static char *put_text(char *out, const char *text)
{
    while (*text)
        *out++ = *text++;
    return out;
}

static char *put_number(char *out, uint32_t value)
{
    char digits[10];
    int n = 0;
    do
        digits[n++] = (char)('0' + value % 10);
    while (value /= 10);
    while (n)
        *out++ = digits[--n];
    return out;
}

static char *put_ipv4(char *out, uint32_t address)
{
    for (int shift = 24; shift >= 0; shift -= 8) {
        out = put_number(out, address >> shift & 255);
        *out++ = '.';
    }
    return out - 1;
}

static char *put_ipv6(char *out, uint64_t hi, uint64_t lo)
{
    uint8_t bytes[16];
    for (int i = 0; i < 8; i++) {
        bytes[i] = (uint8_t)(hi >> (56 - 8 * i));
        bytes[8 + i] = (uint8_t)(lo >> (56 - 8 * i));
    }
    char text[INET6_ADDRSTRLEN];
    inet_ntop(AF_INET6, bytes, text, sizeof text);
    return put_text(out, text);
}

static char *put_mac(char *out, uint64_t mac)
{
    static const char hex[] = "0123456789abcdef";
    for (int shift = 40; shift >= 0; shift -= 8) {
        *out++ = hex[mac >> (shift + 4) & 15];
        *out++ = hex[mac >> shift & 15];
        *out++ = ':';
    }
    return out - 1;
}

typedef struct {
    char text[64];
    int length;
} Part;

static void part_end(Part *part, char *end)
{
    part->length = (int)(end - part->text);
}

static char *put_port(char *out, int32_t port)
{
    return port < 0 ? out : put_number(out, (uint32_t)port);
}

typedef struct {
    Part mac, ip, proto;
} Side;

static void read_sides(const Columns *c, long i, Side *src, Side *dst, int *is_arp)
{
    part_end(&src->mac, put_mac(src->mac.text, c->eth_src[i]));
    part_end(&dst->mac, put_mac(dst->mac.text, c->eth_dst[i]));
    char *a = src->ip.text, *b = dst->ip.text;
    if (c->ip_version[i] == 4) {
        a = put_ipv4(a, (uint32_t)c->ip_src_lo[i]);
        b = put_ipv4(b, (uint32_t)c->ip_dst_lo[i]);
    } else if (c->ip_version[i] == 6) {
        a = put_ipv6(a, c->ip_src_hi[i], c->ip_src_lo[i]);
        b = put_ipv6(b, c->ip_dst_hi[i], c->ip_dst_lo[i]);
    }
    char *p = put_port(put_port(src->proto.text, c->tcp_sport[i]), c->udp_sport[i]);
    char *q = put_port(put_port(dst->proto.text, c->tcp_dport[i]), c->udp_dport[i]);
    *is_arp = 0;
    if (p == src->proto.text) {
        if (c->arp_op[i] >= 0) {
            *is_arp = 1;
            p = put_text(src->proto.text, "arp");
            q = put_text(dst->proto.text, "arp");
            a = put_ipv4(src->ip.text, c->arp_src_ip[i]);
            b = put_ipv4(dst->ip.text, c->arp_dst_ip[i]);
        } else if (c->icmp_type[i] >= 0) {
            p = put_text(src->proto.text, "icmp");
            q = put_text(dst->proto.text, "icmp");
        } else if (a == src->ip.text && b == dst->ip.text && q == dst->proto.text) {
            a = put_mac(src->ip.text, c->eth_src[i]);
            b = put_mac(dst->ip.text, c->eth_dst[i]);
        }
    }
    part_end(&src->ip, a);
    part_end(&dst->ip, b);
    part_end(&src->proto, p);
    part_end(&dst->proto, q);
}

static uint64_t mix(uint64_t h)
{
    h ^= h >> 32;
    h *= 0x9E3779B97F4A7C15u;
    return h ^ h >> 29;
}

static uint32_t hash_key(const Key *key)
{
    uint64_t h = 0x243F6A8885A308D3u, word;
    int bytes = key->length + 1;
    for (int i = 0; i < bytes; i += 8) {
        memcpy(&word, (const char *)key + i, 8);
        h = mix(h ^ word);
    }
    return (uint32_t)(h ^ h >> 32);
}

static uint32_t hash_pair(int32_t a, int32_t b)
{
    uint32_t lo = (uint32_t)(a < b ? a : b), hi = (uint32_t)(a < b ? b : a);
    uint64_t h = mix(mix((uint64_t)hi << 32 | lo));
    return (uint32_t)(h ^ h >> 32);
}

typedef struct {
    Key key;
    uint32_t hash;
} Name;

static void join(Name *name, const Part *first, const Part *second)
{
    Key *key = &name->key;
    memset(key, 0, sizeof *key);
    memcpy(key->text, first->text, (size_t)first->length);
    if (second)
        memcpy(key->text + first->length, second->text, (size_t)second->length);
    key->length = (uint8_t)(first->length + (second ? second->length : 0));
    name->hash = hash_key(key);
}

/* The names under which one packet is known in the four tables. */
typedef struct {
    Name mac_ip, host, peer_host, hosts, socket, peer_socket;
} Names;

static void read_names(const Columns *columns, long i, Names *names)
{
    Side src, dst;
    int is_arp;
    read_sides(columns, i, &src, &dst, &is_arp);
    join(&names->mac_ip, &src.mac, &src.ip);
    join(&names->host, &src.ip, NULL);
    join(&names->peer_host, &dst.ip, NULL);
    join(&names->hosts, &src.ip, &dst.ip);
    join(&names->socket, is_arp ? &src.mac : &src.ip, is_arp ? NULL : &src.proto);
    join(&names->peer_socket, is_arp ? &dst.mac : &dst.ip, is_arp ? NULL : &dst.proto);
}

#endif
