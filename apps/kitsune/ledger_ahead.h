/* Rows ahead of the one whose turn it is: what they will look up is fetched early, since most of it is far away in memory. */

#ifndef LEDGER_AHEAD_H
#define LEDGER_AHEAD_H

#define AHEAD 8

typedef struct {
    Row row;
    uint32_t there, back, pair, owner;
} Ahead;

/* All tables hash with one seed. */
static void look_ahead(const Behaviour *b, const PacketRows *rows, long i, Ahead *ahead)
{
    Row *row = &ahead->row;
    read_row(rows, i, row);
    int six = is_six(row->source), first = comes_first(row->source, row->target);
    Subject there = contact_of(row->source, row->target, row->service), back = contact_of(row->target, row->source, row->reverse);
    Subject pair = first ? pair_of(six, 0, row->source, row->target) : pair_of(six, 0, row->target, row->source);
    Subject owner = pair_of(six, row->mac, row->source, NOBODY);
    ahead->there = hash_of(&b->known, &there);
    ahead->back = hash_of(&b->known, &back);
    ahead->pair = hash_of(&b->exchanges, &pair);
    ahead->owner = hash_of(&b->owner_macs, &owner);
    table_fetch_chain(&b->pending, ahead->back);
    table_fetch_chain(&b->known, ahead->back);
    table_fetch_chain(&b->pending, ahead->there);
    table_fetch_chain(&b->known, ahead->there);
    table_fetch_chain(&b->exchanges, ahead->pair);
    table_fetch_chain(&b->owner_macs, ahead->owner);
}

static void fetch_entries(const Behaviour *b, const Ahead *ahead)
{
    table_fetch_entry(&b->pending, ahead->back);
    table_fetch_entry(&b->known, ahead->back);
    table_fetch_entry(&b->pending, ahead->there);
    table_fetch_entry(&b->known, ahead->there);
    table_fetch_entry(&b->exchanges, ahead->pair);
    table_fetch_entry(&b->owner_macs, ahead->owner);
}

#endif
