/* Rows ahead of the one whose turn it is: what they will look up is fetched early, since most of it is far away in memory. */

#ifndef BEHAVIOUR_PREFETCH_H
#define BEHAVIOUR_PREFETCH_H

#define AHEAD 8

static inline void look_ahead(const Behaviour *b, const Row *row, uint16_t number, Keys *keys)
{
    keys->there = keyed_by(b, contact_of(row->source, row->target, row->service));
    keys->back = keyed_by(b, contact_of(row->target, row->source, row->reverse));
    keys->hosts = keyed_by(b, hosts_of(row));
    keys->owner = keyed_by(b, pair_of(is_six(row->source), row->mac, row->source, NOBODY));
    fetch_slot(&b->known, keys->back.hash);
    fetch_slot(&b->known, keys->there.hash);
    fetch_slot(&b->exchanges, keys->hosts.hash);
    fetch_slot(&b->owner_macs, keys->owner.hash);
    keys->is_login = row->is_tcp && !row->quoted && is_login(b, row->service);
    if (!keys->is_login)
        return;
    keys->login = keyed_by(b, login_of(row->source, row->target, row->service, row->reverse));
    keys->visit = keyed_by(b, visit_of(row->source, row->target));
    fetch_slot(&b->logins, keys->login.hash);
    if (row->flags & SYN) {
        fetch_slot(&b->visits, keys->visit.hash);
        Key counted = keyed_by(b, with_more(sender_of(number, row, row->source, 0), (uint64_t)row->service, row->target));
        fetch_slot(&b->counter[LOGINS].events, counted.hash);
    }
}

static inline void fetch_entries(const Behaviour *b, const Keys *keys)
{
    fetch_entry(&b->known, &keys->back);
    fetch_entry(&b->known, &keys->there);
    fetch_entry(&b->exchanges, &keys->hosts);
    fetch_entry(&b->owner_macs, &keys->owner);
    if (keys->is_login)
        fetch_entry(&b->logins, &keys->login);
}

#endif
