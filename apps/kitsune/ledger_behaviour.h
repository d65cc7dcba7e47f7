/* State of `behaviour.c`, the events that it returns, and the contacts of `behaviour/contacts.py`. */

#ifndef LEDGER_BEHAVIOUR_H
#define LEDGER_BEHAVIOUR_H

#include "ledger_counter.h"
#include "ledger_rows.h"

#define MOST_BLOCKS 64
#define NO_SERVICE (-1)

/* In the order of `native.STATISTICS`. */
enum { CONTACTS, PORTS, TARGETS, LOGINS, ONE_WAY, CLAIMS, THEFTS, STRANGERS, SCORES, STATISTICS, THRESHOLD = STATISTICS, CALLBACKS, NEW_SENDER, NEW_OWNER };

/* A finding (block < 0), sums of training (block >= 0), a sender or an owner of an address first seen. */
typedef struct {
    int32_t what, block;
    uint64_t who[4], victim[2];
    int64_t service;
    uint64_t kind;
    double nats, total, count, window, usual, begun, time;
    uint64_t arrival;
    int32_t has_sender, supporting;
    double sums[MOST_WINDOWS];
} BehaviourEvent;

typedef struct {
    double time;
    Subject sender;
    uint64_t arrival;
    int64_t reverse;
    int32_t is_syn, half_open;
} Pending;

typedef struct {
    int failed;
    double time;
    Subject sender;
    Address source, target;
    int64_t service, reverse;
    int is_syn, half_open;
    uint64_t arrival;
} Ended;

typedef struct {
    double deadline;
    Subject contact;
} Due;

/* A ring; ends of grace periods in order. */
typedef struct {
    Due *due;
    int64_t from, count, room;
} Dues;

typedef struct {
    Subject sender;
    double time;
} Trained;

typedef struct {
    int64_t second, out, back, before, due, syns, syns_due;
    int32_t is_there;
} Exchange;

typedef struct {
    Exchange half[2];
} Exchanges;

typedef struct {
    Subject sender;
    int64_t moved;
    int32_t settled;
} Login;

/* Who has logged in, where and when. */
typedef struct {
    Subject sender;
    int64_t service;
    double time;
} Visit;

typedef struct {
    BehaviourLimits limits;
    Counter counter[STATISTICS];
    Table failures, called;                /* Reported */
    Table visits;                          /* by who logged in, and where */
    double callback_nats, callback_usual;
    Table pending, known, vain, proven;    /* by contact; `known` holds a generation */
    Table senders, owners, owner_macs;     /* of training; `owners` when one spoke, `owner_macs` its number */
    Table exchanges, asked, logins, strangers, told, blocked, in_vain;
    uint8_t login_ports[65536 / 8];
    Dues dues[2];                          /* of ARP requests, of all others */
    double arp_grace, slowest_arp;         /* seconds */
    int64_t arp_replies;
    Trained *tail;
    int64_t tail_from, tail_count;
    uint32_t generation;
    int64_t young, exchange_halves;
    int64_t packets, per_block;
    double begun, seconds;
    double one_way_most[4][MOST_BLOCKS];
    double outside_last, outside_gap, silence; /* seconds; `silence` < 0: it means nothing */
    double in_vain_since;
    int outside_heard, outside_reached;
    int learning, failed, in_switch;
    BehaviourEvent *events;
    long event_count, event_room;
} Behaviour;

static BehaviourEvent *new_event(Behaviour *b, int what, int block)
{
    if (b->event_count == b->event_room) {
        long room = b->event_room ? b->event_room * 2 : 256;
        BehaviourEvent *events = realloc(b->events, (size_t)room * sizeof *events);
        if (!events) {
            b->failed = 1;
            return NULL;
        }
        b->events = events;
        b->event_room = room;
    }
    BehaviourEvent *event = &b->events[b->event_count++];
    memset(event, 0, sizeof *event);
    event->what = what;
    event->block = block;
    event->service = NO_SERVICE;
    return event;
}

static void *added(Behaviour *b, Table *table, const Subject *key)
{
    int32_t at = table_add(table, key);
    if (at == NONE) {
        b->failed = 1;
        return NULL;
    }
    return payload(table, at);
}

static void put_bounded(Behaviour *b, Table *table, const Subject *key, int32_t most)
{
    if (table->live >= most)
        table_drop(table, table->oldest);
    if (table_find(table, key) == NONE)
        added(b, table, key);
}

/* ---- contacts */

#define FROM_TRAINING UINT32_MAX

static Subject contact_of(Address source, Address target, int64_t service)
{
    return pair_of((uint32_t)service, is_six(source), source, target);
}

static Address contact_end(const Subject *contact, int target)
{
    Address found = {contact->word[2 + 2 * target], contact->word[3 + 2 * target], contact->word[1] ? 6 : 4};
    return found;
}

static int knows(const Behaviour *b, const Subject *contact)
{
    return table_find(&b->known, contact) != NONE;
}

static int came_about(const Behaviour *b, const Subject *contact)
{
    return knows(b, contact) && table_find(&b->pending, contact) == NONE && table_find(&b->vain, contact) == NONE;
}

static void drop_old_contacts(Behaviour *b)
{
    for (int32_t at = b->known.oldest, newer; at != NONE; at = newer) {
        newer = head(&b->known, at)->newer;
        uint32_t generation = *(uint32_t *)payload(&b->known, at);
        if (generation != FROM_TRAINING && generation + 1 < b->generation)
            table_drop(&b->known, at);
    }
}

static void remember(Behaviour *b, const Subject *contact)
{
    uint32_t *generation = added(b, &b->known, contact);
    if (!generation)
        return;
    *generation = b->generation;
    if (++b->young >= b->limits.most_contacts) {
        b->generation++;
        b->young = 0;
        drop_old_contacts(b);
    }
}

static double grace_of(const Behaviour *b, const Subject *contact)
{
    return (int64_t)contact->word[0] == ARP ? b->arp_grace : b->limits.grace_s;
}

static void push_due(Behaviour *b, double time, const Subject *contact)
{
    Dues *dues = &b->dues[(int64_t)contact->word[0] != ARP];
    if (dues->count == dues->room) {
        int64_t room = dues->room ? dues->room * 2 : 1024;
        Due *due = malloc((size_t)room * sizeof *due);
        if (!due) {
            b->failed = 1;
            return;
        }
        for (int64_t i = 0; i < dues->count; i++)
            due[i] = dues->due[(dues->from + i) & (dues->room - 1)];
        free(dues->due);
        dues->due = due;
        dues->room = room;
        dues->from = 0;
    }
    Due *last = &dues->due[(dues->from + dues->count++) & (dues->room - 1)];
    last->deadline = time + grace_of(b, contact);
    last->contact = *contact;
}

/* The queue whose turn it is at `now`, if there is one. */
static Dues *dues_at(Behaviour *b, double now)
{
    Dues *first = NULL;
    for (int which = 0; which < 2; which++) {
        Dues *dues = &b->dues[which];
        if (dues->count && (!first || dues->due[dues->from].deadline < first->due[first->from].deadline))
            first = dues;
    }
    return first && first->due[first->from].deadline <= now ? first : NULL;
}

static void end_contact(Behaviour *b, const Subject *contact, int32_t at, double time, int failed, Ended *ended)
{
    const Pending *pending = payload(&b->pending, at);
    Ended found = {failed, time, pending->sender, contact_end(contact, 0), contact_end(contact, 1), (int64_t)contact->word[0],
                   pending->reverse, pending->is_syn, pending->half_open, pending->arrival};
    *ended = found;
    table_drop(&b->pending, at);
    if (failed)
        put_bounded(b, &b->vain, contact, b->limits.most_contacts);
    else if (found.half_open) {
        Subject address = pair_of(contact->word[1], 0, found.source, (Address){0, 0, 0});
        put_bounded(b, &b->proven, &address, b->limits.most_contacts);
    }
}

/* The next contact whose grace period is over at `now`. */
static int next_due(Behaviour *b, double now, Ended *ended)
{
    for (Dues *dues; (dues = dues_at(b, now));) {
        Subject contact = dues->due[dues->from].contact;
        dues->from = (dues->from + 1) & (dues->room - 1);
        dues->count--;
        int32_t at = table_find(&b->pending, &contact);
        if (at != NONE) {
            double since = ((Pending *)payload(&b->pending, at))->time;
            end_contact(b, &contact, at, since + grace_of(b, &contact), 1, ended);
            return 1;
        }
    }
    return 0;
}

static int answered(Behaviour *b, const Row *row, const Subject *contact, int32_t at, Ended *ended)
{
    if (row->is_tcp && !(row->flags & RST) && (row->flags & (SYN | ACK)) == (SYN | ACK)) {
        ((Pending *)payload(&b->pending, at))->half_open = 1;
        return 0;
    }
    if (b->learning && row->service == ARP) {
        b->arp_replies++;
        b->slowest_arp = fmax(b->slowest_arp, row->time - ((Pending *)payload(&b->pending, at))->time);
    }
    end_contact(b, contact, at, row->time, row->is_tcp && row->flags & RST, ended);
    return 1;
}

/* Follows one packet; whether it ends a contact. */
static int follow_contact(Behaviour *b, const Row *row, const Subject *sender, Ended *ended)
{
    if (row->quoted || row->group)
        return 0;
    Subject back = contact_of(row->target, row->source, row->reverse);
    int32_t at = table_find(&b->pending, &back);
    if (at != NONE)
        return answered(b, row, &back, at, ended);
    if (row->answer || knows(b, &back))
        return 0;
    Subject there = contact_of(row->source, row->target, row->service);
    at = table_find(&b->pending, &there);
    if (at != NONE) {
        int completes = ((Pending *)payload(&b->pending, at))->half_open && row->flags & ACK && !(row->flags & (RST | SYN));
        if (completes)
            end_contact(b, &there, at, row->time, 0, ended);
        return completes;
    }
    if (knows(b, &there) || (row->is_tcp && is_tcp_reply(row->flags)))
        return 0;
    remember(b, &there);
    if (b->pending.live < b->limits.most_contacts) {
        Pending *pending = added(b, &b->pending, &there);
        if (pending) {
            Pending begun = {row->time, *sender, row->arrival, row->reverse, (row->flags & SYN) != 0, 0};
            *pending = begun;
            push_due(b, row->time, &there);
        }
    }
    return 0;
}

#endif
