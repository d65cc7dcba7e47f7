/* Numbered cells: found by hash, handed out and taken back, kept in order of use.
 *
 * What is needed to find and age a cell lies in small slots apart from the cells, so that neighbours in
 * a chain or in the order of use are not fetched from memory with all their statistics.
 */

#ifndef AFTERIMAGE_POOL_H
#define AFTERIMAGE_POOL_H

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define NONE (-1)

typedef struct {
    uint32_t hash;
    int32_t next; /* in the bucket, or among the free cells */
    int32_t older, newer;
} Slot;

typedef struct {
    void *cells;
    size_t cell_size;
    Slot *slot;
    int32_t *bucket;
    uint32_t mask;
    int32_t used, room, limit, free, live;
    int32_t oldest, newest;
} Pool;

static int pool_start(Pool *pool, size_t cell_size, int32_t limit)
{
    memset(pool, 0, sizeof *pool);
    pool->cell_size = cell_size;
    pool->limit = limit;
    pool->free = pool->oldest = pool->newest = NONE;
    pool->mask = 1023;
    pool->bucket = malloc((pool->mask + 1) * sizeof *pool->bucket);
    if (!pool->bucket)
        return -1;
    memset(pool->bucket, 0xFF, (pool->mask + 1) * sizeof *pool->bucket);
    return 0;
}

static void pool_end(Pool *pool)
{
    free(pool->cells);
    free(pool->slot);
    free(pool->bucket);
}

static int pool_grow(Pool *pool)
{
    int32_t room = pool->room ? (pool->room > INT32_MAX / 2 ? INT32_MAX : pool->room * 2) : 256;
    if (pool->limit && room > pool->limit)
        room = pool->limit;
    if (room <= pool->room)
        return -1;
    void *cells = realloc(pool->cells, (size_t)room * pool->cell_size);
    if (!cells)
        return -1;
    pool->cells = cells;
    Slot *slot = realloc(pool->slot, (size_t)room * sizeof *slot);
    if (!slot)
        return -1;
    pool->slot = slot;
    pool->room = room;
    return 0;
}

static void chain(Pool *pool, int32_t at)
{
    int32_t *head = &pool->bucket[pool->slot[at].hash & pool->mask];
    pool->slot[at].next = *head;
    *head = at;
}

static void pool_spread(Pool *pool)
{
    uint32_t mask = pool->mask * 4 + 3;
    int32_t *bucket = malloc(((size_t)mask + 1) * sizeof *bucket);
    if (!bucket)
        return; /* longer chains still work */
    memset(bucket, 0xFF, ((size_t)mask + 1) * sizeof *bucket);
    free(pool->bucket);
    pool->bucket = bucket;
    pool->mask = mask;
    for (int32_t at = pool->oldest; at != NONE; at = pool->slot[at].newer)
        chain(pool, at);
}

static void detach(Pool *pool, int32_t at)
{
    const Slot *slot = &pool->slot[at];
    *(slot->older == NONE ? &pool->oldest : &pool->slot[slot->older].newer) = slot->newer;
    *(slot->newer == NONE ? &pool->newest : &pool->slot[slot->newer].older) = slot->older;
}

static void attach(Pool *pool, int32_t at)
{
    pool->slot[at].older = pool->newest;
    pool->slot[at].newer = NONE;
    *(pool->newest == NONE ? &pool->oldest : &pool->slot[pool->newest].newer) = at;
    pool->newest = at;
}

/* The cell was used: now it is the newest. */
static void pool_renew(Pool *pool, int32_t at)
{
    if (pool->newest != at) {
        detach(pool, at);
        attach(pool, at);
    }
}

/* A cell of its own for `hash`, or NONE when memory is short.  The caller keeps `live` below `limit`. */
static int32_t pool_take(Pool *pool, uint32_t hash)
{
    int32_t at = pool->free;
    if (at != NONE)
        pool->free = pool->slot[at].next;
    else if (pool->used < pool->room || !pool_grow(pool))
        at = pool->used++;
    else
        return NONE;
    pool->slot[at].hash = hash;
    attach(pool, at);
    pool->live++;
    if ((uint32_t)pool->live > pool->mask)
        pool_spread(pool);
    else
        chain(pool, at);
    return at;
}

static void pool_give_back(Pool *pool, int32_t at)
{
    int32_t *link = &pool->bucket[pool->slot[at].hash & pool->mask];
    while (*link != at)
        link = &pool->slot[*link].next;
    *link = pool->slot[at].next;
    detach(pool, at);
    pool->slot[at].next = pool->free;
    pool->free = at;
    pool->live--;
}

#endif
