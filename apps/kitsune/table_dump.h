/* Tables of the trackers as bytes, and back: entries keep their numbers and their order.  See `state_dump.h`. */

#ifndef TABLE_DUMP_H
#define TABLE_DUMP_H

#include "packet_rows.h"
#include "state_dump.h"

typedef void (*DumpPayload)(Dump *, void *context, void *payload);

/* Room for `used` entries, none of which is live; the table is a fresh one. */
static void table_make(Dump *dump, Table *table, int32_t used, int32_t live)
{
    int32_t room = 64;
    uint32_t mask = table->mask;
    while (room < used)
        room *= 2;
    while ((uint32_t)live > mask / 2)
        mask = mask * 2 + 1;
    char *entries = calloc((size_t)room, table->stride);
    Slot *slot = free_slots(mask);
    if (dump->failed || !entries || !slot) {
        free(entries);
        free(slot);
        dump->failed = dump->failed ? dump->failed : NO_MEMORY;
        return;
    }
    free(table->entries);
    free(table->slot);
    table->entries = entries;
    table->slot = slot;
    table->mask = mask;
    table->room = room;
    table->used = used;
    for (int32_t at = 0; at < used; at++)
        head(table, at)->older = VACANT;
}

/* An entry that no list has named before. */
static int32_t fresh_entry(Dump *dump, const Table *table, int32_t at)
{
    DUMP(dump, at);
    dump_check(dump, at >= 0 && at < table->used);
    if (dump->failed)
        return NONE;
    if (dump->in) /* free entries that were met have themselves as the newer one */
        dump_check(dump, head(table, at)->older == VACANT && head(table, at)->newer != VACANT);
    return dump->failed ? NONE : at;
}

static void dump_live(Dump *dump, Table *table, int32_t live, DumpPayload each, void *context)
{
    int32_t next = table->oldest;
    for (int32_t n = 0; n < live && !dump->failed; n++) {
        int32_t at = fresh_entry(dump, table, next);
        if (at == NONE)
            return;
        Head *entry = head(table, at);
        DUMP(dump, entry->key);
        if (dump->in) {
            entry->hash = hash_of(table->seed, &entry->key);
            table_append(table, at);
            table_put(table, entry->hash, at);
            table->live++;
        }
        if (each)
            each(dump, context, payload(table, at));
        else
            dump_bytes(dump, payload(table, at), table->stride - sizeof(Head));
        next = entry->newer;
    }
}

static void dump_free(Dump *dump, Table *table, int32_t free)
{
    int32_t next = table->free, last = NONE;
    for (int32_t n = 0; n < free && !dump->failed; n++) {
        int32_t at = fresh_entry(dump, table, next);
        if (at == NONE)
            return;
        Head *entry = head(table, at);
        if (dump->in) {
            entry->newer = VACANT;
            entry->next = NONE;
            *(last == NONE ? &table->free : &head(table, last)->next) = at;
            last = at;
        }
        next = entry->next;
    }
}

/* A table of which `each` dumps the payloads; NULL: they are plain bytes, none of which is an index. */
static void dump_table(Dump *dump, Table *table, DumpPayload each, void *context)
{
    int32_t used = table->used, live = table->live;
    dump_same(dump, (int64_t)table->stride);
    dump_cells(dump, &used, &live);
    if (dump->in && !dump->failed)
        table_make(dump, table, used, live);
    dump_live(dump, table, live, each, context);
    dump_free(dump, table, used - live);
}

static int is_entry(const Table *table, int32_t at)
{
    return at >= 0 && at < table->used && head(table, at)->older != VACANT;
}

/* Whether an address is one that its version can have; 0: none. */
static int is_address(uint64_t version, uint64_t hi, uint64_t lo)
{
    return version == 6 || (version == 4 && !hi && lo >> 32 == 0) || (!version && !hi && !lo);
}

#endif
