/* Hash tables of the trackers: keys of six words, entries in order of insertion, numbers that stay while they live.
 *
 * Slots are probed one after the other and hold the hash beside the number, so that who looks for a key that is not
 * there reads no entry.  Tables of one tracker share a seed, so that a key is hashed once for all of them.
 */

#ifndef HASH_TABLE_H
#define HASH_TABLE_H

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define NONE (-1)
#define VACANT (-2)
#define WORDS 6

typedef struct {
    uint64_t word[WORDS];
} Subject;

/* A subject and its hash. */
typedef struct {
    Subject subject;
    uint32_t hash;
} Key;

typedef struct {
    Subject key;
    uint32_t hash;
    int32_t next; /* among the free entries */
    int32_t older, newer; /* older is VACANT in free entries */
} Head;

typedef struct {
    uint32_t hash;
    int32_t at; /* NONE: free */
} Slot;

typedef struct {
    char *entries;
    Slot *slot;
    size_t stride;
    uint32_t mask;
    int32_t used, room, free, live;
    int32_t oldest, newest;
    uint64_t seed;
} Table;

static inline uint64_t fold(uint64_t a, uint64_t b)
{
    unsigned __int128 product = (unsigned __int128)a * b;
    return (uint64_t)product ^ (uint64_t)(product >> 64);
}

static inline uint32_t hash_of(uint64_t s, const Subject *subject)
{
    const uint64_t *w = subject->word;
    uint64_t h = fold(w[0] ^ s, w[1] ^ 0x9E3779B97F4A7C15u) ^ fold(w[2] ^ s ^ 0xA0761D6478BD642Fu, w[3] ^ 0xE7037ED1A0B428DBu)
                 ^ fold(w[4] ^ s ^ 0x8EBC6AF09C88C6E3u, w[5] ^ 0x589965CC75374CC3u);
    h = fold(h ^ s, 0x1D8E4E27C47D124Fu);
    return (uint32_t)(h ^ h >> 32);
}

static inline Key keyed(const Table *any, Subject subject)
{
    Key key = {subject, hash_of(any->seed, &subject)};
    return key;
}

static Slot *free_slots(uint32_t mask)
{
    size_t bytes = ((size_t)mask + 1) * sizeof(Slot);
    Slot *slot = malloc(bytes);
    if (slot)
        memset(slot, 0xFF, bytes);
    return slot;
}

static int table_start(Table *table, size_t payload, uint64_t seed)
{
    memset(table, 0, sizeof *table);
    table->stride = sizeof(Head) + ((payload + 7) & ~(size_t)7);
    table->free = table->oldest = table->newest = NONE;
    table->seed = seed | 1;
    table->mask = 63;
    table->slot = free_slots(table->mask);
    return table->slot ? 0 : -1;
}

static void table_end(Table *table)
{
    free(table->entries);
    free(table->slot);
}

static inline Head *head(const Table *table, int32_t at)
{
    return (Head *)(table->entries + (size_t)at * table->stride);
}

static inline void *payload(const Table *table, int32_t at)
{
    return table->entries + (size_t)at * table->stride + sizeof(Head);
}

static inline int same_subject(const Subject *a, const Subject *b)
{
    uint64_t difference = 0;
    for (int i = 0; i < WORDS; i++)
        difference |= a->word[i] ^ b->word[i];
    return !difference;
}

static inline int32_t find_key(const Table *table, const Key *key)
{
    uint32_t i = key->hash & table->mask;
    for (Slot slot; (slot = table->slot[i]).at != NONE; i = (i + 1) & table->mask)
        if (slot.hash == key->hash && same_subject(&head(table, slot.at)->key, &key->subject))
            return slot.at;
    return NONE;
}

static int32_t table_find(const Table *table, const Subject *subject)
{
    if (!table->live)
        return NONE;
    Key key = keyed(table, *subject);
    return find_key(table, &key);
}

/* What `find_key` will read, fetched early: first the slot, then, a while later, the entry. */
static inline void fetch_slot(const Table *table, uint32_t hash)
{
    __builtin_prefetch(&table->slot[hash & table->mask]);
}

static inline void fetch_entry(const Table *table, const Key *key)
{
    Slot slot = table->slot[key->hash & table->mask];
    if (slot.at == NONE || slot.hash != key->hash)
        return;
    const char *entry = (const char *)head(table, slot.at);
    __builtin_prefetch(entry);
    __builtin_prefetch(entry + sizeof(Head));
}

static void table_put(Table *table, uint32_t hash, int32_t at)
{
    uint32_t i = hash & table->mask;
    while (table->slot[i].at != NONE)
        i = (i + 1) & table->mask;
    table->slot[i].hash = hash;
    table->slot[i].at = at;
}

/* Twice as many slots; 0 when memory is short. */
static int table_spread(Table *table)
{
    Slot *slot = table->mask < UINT32_MAX / 2 ? free_slots(table->mask * 2 + 1) : NULL;
    if (!slot)
        return 0;
    free(table->slot);
    table->slot = slot;
    table->mask = table->mask * 2 + 1;
    for (int32_t at = 0; at < table->used; at++)
        if (head(table, at)->older != VACANT)
            table_put(table, head(table, at)->hash, at);
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

static inline void table_append(Table *table, int32_t at)
{
    head(table, at)->older = table->newest;
    head(table, at)->newer = NONE;
    *(table->newest == NONE ? &table->oldest : &head(table, table->newest)->newer) = at;
    table->newest = at;
}

static inline void table_unlink(Table *table, int32_t at)
{
    const Head *each = head(table, at);
    *(each->older == NONE ? &table->oldest : &head(table, each->older)->newer) = each->newer;
    *(each->newer == NONE ? &table->newest : &head(table, each->newer)->older) = each->older;
}

/* A new entry, which the caller has not found; its payload is zero.  NONE when memory is short. */
static int32_t add_key(Table *table, const Key *key)
{
    uint32_t live = (uint32_t)table->live + 1;
    if (live > table->mask / 2 && !table_spread(table) && live > table->mask - table->mask / 8)
        return NONE;
    int32_t at = table->free;
    if (at != NONE)
        table->free = head(table, at)->next;
    else if (table->used < table->room || !table_grow(table))
        at = table->used++;
    else
        return NONE;
    Head *each = head(table, at);
    memset(payload(table, at), 0, table->stride - sizeof *each);
    each->key = key->subject;
    each->hash = key->hash;
    table_append(table, at);
    table->live++;
    table_put(table, key->hash, at);
    return at;
}

static int32_t table_add(Table *table, const Subject *subject)
{
    Key key = keyed(table, *subject);
    return add_key(table, &key);
}

/* Frees a slot; what was pushed on by it moves back, so that no search ends too early. */
static void table_take(Table *table, uint32_t hash, int32_t at)
{
    uint32_t mask = table->mask, i = hash & mask;
    while (table->slot[i].at != at)
        i = (i + 1) & mask;
    for (uint32_t j = (i + 1) & mask; table->slot[j].at != NONE; j = (j + 1) & mask)
        if (((j - table->slot[j].hash) & mask) >= ((j - i) & mask)) {
            table->slot[i] = table->slot[j];
            i = j;
        }
    table->slot[i].at = NONE;
}

static void table_drop(Table *table, int32_t at)
{
    Head *each = head(table, at);
    table_take(table, each->hash, at);
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
    memset(table->slot, 0xFF, ((size_t)table->mask + 1) * sizeof *table->slot);
    table->used = table->live = 0;
    table->free = table->oldest = table->newest = NONE;
}

/* The entry was used: now it is the newest. */
static inline void table_renew(Table *table, int32_t at)
{
    if (table->newest != at) {
        table_unlink(table, at);
        table_append(table, at);
    }
}

#endif
