/* Hash tables of the ledgers: keys of six words, entries in order of insertion, numbers that stay while they live. */

#ifndef LEDGER_TABLE_H
#define LEDGER_TABLE_H

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define NONE (-1)
#define VACANT (-2)
#define WORDS 6

typedef struct {
    uint64_t word[WORDS];
} Subject;

typedef struct {
    Subject key;
    uint32_t hash;
    int32_t next;
    int32_t older, newer; /* older is VACANT in free entries */
} Head;

typedef struct {
    char *entries;
    int32_t *bucket;
    size_t stride;
    uint32_t mask;
    int32_t used, room, free, live;
    int32_t oldest, newest;
    uint64_t seed;
} Table;

static uint64_t fold(uint64_t a, uint64_t b)
{
    unsigned __int128 product = (unsigned __int128)a * b;
    return (uint64_t)product ^ (uint64_t)(product >> 64);
}

static uint32_t hash_of(const Table *table, const Subject *key)
{
    const uint64_t *w = key->word, s = table->seed;
    uint64_t h = fold(w[0] ^ s, w[1] ^ 0x9E3779B97F4A7C15u) ^ fold(w[2] ^ s ^ 0xA0761D6478BD642Fu, w[3] ^ 0xE7037ED1A0B428DBu)
                 ^ fold(w[4] ^ s ^ 0x8EBC6AF09C88C6E3u, w[5] ^ 0x589965CC75374CC3u);
    h = fold(h ^ s, 0x1D8E4E27C47D124Fu);
    return (uint32_t)(h ^ h >> 32);
}

static int table_start(Table *table, size_t payload, uint64_t seed)
{
    memset(table, 0, sizeof *table);
    table->stride = sizeof(Head) + ((payload + 7) & ~(size_t)7);
    table->free = table->oldest = table->newest = NONE;
    table->seed = seed | 1;
    table->mask = 63;
    table->bucket = malloc((table->mask + 1) * sizeof *table->bucket);
    if (!table->bucket)
        return -1;
    memset(table->bucket, 0xFF, (table->mask + 1) * sizeof *table->bucket);
    return 0;
}

static void table_end(Table *table)
{
    free(table->entries);
    free(table->bucket);
}

static Head *head(const Table *table, int32_t at)
{
    return (Head *)(table->entries + (size_t)at * table->stride);
}

static void *payload(const Table *table, int32_t at)
{
    return table->entries + (size_t)at * table->stride + sizeof(Head);
}

static int same_subject(const Subject *a, const Subject *b)
{
    uint64_t difference = 0;
    for (int i = 0; i < WORDS; i++)
        difference |= a->word[i] ^ b->word[i];
    return !difference;
}

static int32_t table_find(const Table *table, const Subject *key)
{
    if (!table->live)
        return NONE;
    uint32_t hash = hash_of(table, key);
    for (int32_t at = table->bucket[hash & table->mask]; at != NONE; at = head(table, at)->next) {
        const Head *found = head(table, at);
        if (found->hash == hash && same_subject(&found->key, key))
            return at;
    }
    return NONE;
}

/* What `table_find` will read, fetched early: first where a chain begins, then, a while later, its first entry. */
static void table_fetch_chain(const Table *table, uint32_t hash)
{
    __builtin_prefetch(&table->bucket[hash & table->mask]);
}

static void table_fetch_entry(const Table *table, uint32_t hash)
{
    int32_t at = table->bucket[hash & table->mask];
    if (at == NONE)
        return;
    const char *entry = (const char *)head(table, at);
    __builtin_prefetch(entry);
    __builtin_prefetch(entry + sizeof(Head) - 1);
}

/* More buckets; 0 when memory is short: longer chains still work. */
static int table_spread(Table *table)
{
    uint32_t mask = table->mask * 4 + 3;
    int32_t *bucket = malloc(((size_t)mask + 1) * sizeof *bucket);
    if (!bucket)
        return 0;
    memset(bucket, 0xFF, ((size_t)mask + 1) * sizeof *bucket);
    free(table->bucket);
    table->bucket = bucket;
    table->mask = mask;
    for (int32_t at = 0; at < table->used; at++) {
        Head *each = head(table, at);
        if (each->older != VACANT) {
            each->next = bucket[each->hash & mask];
            bucket[each->hash & mask] = at;
        }
    }
    return 1;
}

static int table_grow(Table *table)
{
    if (table->room > INT32_MAX / 2)
        return -1;
    int32_t room = table->room ? table->room * 2 : 64;
    char *entries = realloc(table->entries, (size_t)room * table->stride);
    if (!entries)
        return -1;
    table->entries = entries;
    table->room = room;
    return 0;
}

static void table_append(Table *table, int32_t at)
{
    head(table, at)->older = table->newest;
    head(table, at)->newer = NONE;
    *(table->newest == NONE ? &table->oldest : &head(table, table->newest)->newer) = at;
    table->newest = at;
}

static void table_unlink(Table *table, int32_t at)
{
    const Head *each = head(table, at);
    *(each->older == NONE ? &table->oldest : &head(table, each->older)->newer) = each->newer;
    *(each->newer == NONE ? &table->newest : &head(table, each->newer)->older) = each->older;
}

/* A new entry, which the caller has not found; its payload is zero.  NONE when memory is short. */
static int32_t table_add(Table *table, const Subject *key)
{
    int32_t at = table->free;
    if (at != NONE)
        table->free = head(table, at)->next;
    else if (table->used < table->room || !table_grow(table))
        at = table->used++;
    else
        return NONE;
    Head *each = head(table, at);
    memset(each, 0, table->stride);
    each->key = *key;
    each->hash = hash_of(table, key);
    table_append(table, at);
    if ((uint32_t)++table->live > table->mask && table_spread(table))
        return at;
    each->next = table->bucket[each->hash & table->mask];
    table->bucket[each->hash & table->mask] = at;
    return at;
}

static void table_drop(Table *table, int32_t at)
{
    Head *each = head(table, at);
    int32_t *link = &table->bucket[each->hash & table->mask];
    while (*link != at)
        link = &head(table, *link)->next;
    *link = each->next;
    table_unlink(table, at);
    each->next = table->free;
    each->older = VACANT;
    table->free = at;
    table->live--;
}

static void table_clear(Table *table)
{
    if (!table->used)
        return;
    memset(table->bucket, 0xFF, ((size_t)table->mask + 1) * sizeof *table->bucket);
    table->used = table->live = 0;
    table->free = table->oldest = table->newest = NONE;
}

/* The entry was used: now it is the newest. */
static void table_renew(Table *table, int32_t at)
{
    if (table->newest != at) {
        table_unlink(table, at);
        table_append(table, at);
    }
}

#endif
