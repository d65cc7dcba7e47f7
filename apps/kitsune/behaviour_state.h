/* State of `behaviour.c`, the events that it returns, and the contacts of `behaviour/contacts.py`. */

#ifndef BEHAVIOUR_STATE_H
#define BEHAVIOUR_STATE_H

#include "behaviour_counter.h"
#include "packet_rows.h"

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
    int32_t known; /* its number there; NONE: forgotten there */
} Pending;

typedef struct {
    uint32_t generation;
    int32_t pending; /* its number there, or NONE */
} Known;

typedef struct {
    int failed;
    double time;
    Subject sender;
    Address source, target;
    int64_t service, reverse;
    int is_syn, half_open;
    uint64_t arrival;
} Ended;

/* Of one packet: contact there and back, pair of hosts, owner of the source; to a login service also connection and visit. */
typedef struct {
    Key there, back, hosts, owner, login, visit;
    int is_login;
} Keys;

typedef struct {
    double deadline;
    Key contact;
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
    Table pending, known, vain, proven;    /* by contact */
    Table senders, owners, owner_macs;     /* of training; `owners` when one spoke, `owner_macs` its number */
    Table exchanges, asked, logins, strangers, told, blocked, in_vain;
    uint8_t login_ports[65536 / 8];
    Dues dues[2];                          /* of ARP requests, of all others */
    double arp_grace, slowest_arp;         /* seconds */
    int64_t arp_replies;
    Trained *tail;
    int64_t tail_from, tail_count;
    uint32_t generation;
    int64_t young, exchange_halves, orphans; /* `orphans`: pending contacts that are not known any more */
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

static void *added_key(Behaviour *b, Table *table, const Key *key)
{
    int32_t at = add_key(table, key);
    if (at == NONE) {
        b->failed = 1;
        return NULL;
    }
    return payload(table, at);
}

static void *added(Behaviour *b, Table *table, const Subject *subject)
{
    Key key = keyed(table, *subject);
    return added_key(b, table, &key);
}

static void put_bounded(Behaviour *b, Table *table, const Key *key, int32_t most)
{
    if (table->live >= most)
        table_drop(table, table->oldest);
    if (find_key(table, key) == NONE && add_key(table, key) == NONE)
        b->failed = 1;
}

/* ---- contacts */

#define FROM_TRAINING UINT32_MAX

static inline Subject contact_of(Address source, Address target, int64_t service)
{
    return pair_of((uint32_t)service, is_six(source), source, target);
}

static Address contact_end(const Subject *contact, int target)
{
    Address found = {contact->word[2 + 2 * target], contact->word[3 + 2 * target], contact->word[1] ? 6 : 4};
    return found;
}

/* The number of a contact's pending entry, if it has one; `known` is that of what is known of it. */
static inline int32_t pending_of(const Behaviour *b, int32_t known, const Key *contact)
{
    if (known != NONE)
        return ((const Known *)payload(&b->known, known))->pending;
    return b->orphans ? find_key(&b->pending, contact) : NONE;
}

static int came_about(const Behaviour *b, const Key *contact)
{
    int32_t known = find_key(&b->known, contact);
    return known != NONE && pending_of(b, known, contact) == NONE && find_key(&b->vain, contact) == NONE;
}

static void drop_old_contacts(Behaviour *b)
{
    for (int32_t at = b->known.oldest, newer; at != NONE; at = newer) {
        newer = head(&b->known, at)->newer;
        const Known *known = payload(&b->known, at);
        if (known->generation == FROM_TRAINING || known->generation + 1 >= b->generation)
            continue;
        if (known->pending != NONE) {
            ((Pending *)payload(&b->pending, known->pending))->known = NONE;
            b->orphans++;
        }
        table_drop(&b->known, at);
    }
}

static int32_t know_contact(Behaviour *b, const Key *contact, uint32_t generation)
{
    int32_t at = add_key(&b->known, contact);
    if (at == NONE) {
        b->failed = 1;
        return NONE;
    }
    Known known = {generation, NONE};
    *(Known *)payload(&b->known, at) = known;
    return at;
}

static int32_t remember(Behaviour *b, const Key *contact)
{
    int32_t at = know_contact(b, contact, b->generation);
    if (at != NONE && ++b->young >= b->limits.most_contacts) {
        b->generation++;
        b->young = 0;
        drop_old_contacts(b);
    }
    return at;
}

#define LEAST_DUES 1024

static double grace_of(const Behaviour *b, const Key *contact)
{
    return (int64_t)contact->subject.word[0] == ARP ? b->arp_grace : b->limits.grace_s;
}

/* Room for so many, a power of two; 1: there is no memory. */
static int dues_resize(Dues *dues, int64_t room)
{
    Due *due = malloc((size_t)room * sizeof *due);
    if (!due)
        return 1;
    for (int64_t i = 0; i < dues->count; i++)
        due[i] = dues->due[(dues->from + i) & (dues->room - 1)];
    free(dues->due);
    dues->due = due;
    dues->room = room;
    dues->from = 0;
    return 0;
}

static void push_due(Behaviour *b, double time, const Key *contact)
{
    Dues *dues = &b->dues[(int64_t)contact->subject.word[0] != ARP];
    if (dues->count == dues->room && dues_resize(dues, dues->room ? dues->room * 2 : LEAST_DUES)) {
        b->failed = 1;
        return;
    }
    /* else what a burst of contacts needed would be walked through, page by page, for hours after it */
    if (dues->room > LEAST_DUES && dues->count < dues->room / 8)
        (void)dues_resize(dues, dues->room / 2);
    Due *last = &dues->due[(dues->from + dues->count++) & (dues->room - 1)];
    last->deadline = time + grace_of(b, contact);
    last->contact = *contact;
}

/* The queue whose turn it is at `now`, if there is one. */
static inline Dues *dues_at(Behaviour *b, double now)
{
    Dues *first = NULL;
    for (int which = 0; which < 2; which++) {
        Dues *dues = &b->dues[which];
        if (dues->count && (!first || dues->due[dues->from].deadline < first->due[first->from].deadline))
            first = dues;
    }
    return first && first->due[first->from].deadline <= now ? first : NULL;
}

/* Ends the contact whose pending entry is `at`. */
static void end_contact(Behaviour *b, int32_t at, double time, int failed, Ended *ended)
{
    const Pending *pending = payload(&b->pending, at);
    Key contact = {head(&b->pending, at)->key, head(&b->pending, at)->hash};
    const Subject *name = &contact.subject;
    Ended found = {failed, time, pending->sender, contact_end(name, 0), contact_end(name, 1), (int64_t)name->word[0],
                   pending->reverse, pending->is_syn, pending->half_open, pending->arrival};
    *ended = found;
    if (pending->known != NONE)
        ((Known *)payload(&b->known, pending->known))->pending = NONE;
    else
        b->orphans--;
    if (failed)
        put_bounded(b, &b->vain, &contact, b->limits.most_contacts);
    else if (found.half_open) {
        Key address = keyed(&b->proven, pair_of(name->word[1], 0, found.source, (Address){0, 0, 0}));
        put_bounded(b, &b->proven, &address, b->limits.most_contacts);
    }
    table_drop(&b->pending, at);
}

/* The next contact whose grace period is over at `now`. */
static int next_due(Behaviour *b, double now, Ended *ended)
{
    for (Dues *dues; (dues = dues_at(b, now));) {
        Key contact = dues->due[dues->from].contact;
        int32_t at = find_key(&b->pending, &contact);
        dues->from = (dues->from + 1) & (dues->room - 1);
        dues->count--;
        if (dues->count)
            fetch_slot(&b->vain, dues->due[dues->from].contact.hash); /* for the one after this */
        if (at != NONE) {
            double since = ((Pending *)payload(&b->pending, at))->time;
            end_contact(b, at, since + grace_of(b, &contact), 1, ended);
            return 1;
        }
    }
    return 0;
}

static int answered(Behaviour *b, const Row *row, int32_t at, Ended *ended)
{
    if (row->is_tcp && !(row->flags & RST) && (row->flags & (SYN | ACK)) == (SYN | ACK)) {
        ((Pending *)payload(&b->pending, at))->half_open = 1;
        return 0;
    }
    if (b->learning && row->service == ARP) {
        b->arp_replies++;
        b->slowest_arp = fmax(b->slowest_arp, row->time - ((Pending *)payload(&b->pending, at))->time);
    }
    end_contact(b, at, row->time, row->is_tcp && row->flags & RST, ended);
    return 1;
}

static void begin_contact(Behaviour *b, const Row *row, const Subject *sender, const Key *contact)
{
    int32_t known = remember(b, contact);
    if (known == NONE || b->pending.live >= b->limits.most_contacts)
        return;
    int32_t at = add_key(&b->pending, contact);
    if (at == NONE) {
        b->failed = 1;
        return;
    }
    Pending begun = {row->time, *sender, row->arrival, row->reverse, (row->flags & SYN) != 0, 0, known};
    *(Pending *)payload(&b->pending, at) = begun;
    ((Known *)payload(&b->known, known))->pending = at;
    push_due(b, row->time, contact);
}

/* Follows one packet; whether it ends a contact. */
static int follow_contact(Behaviour *b, const Row *row, const Subject *sender, const Keys *keys, Ended *ended)
{
    if (row->quoted || row->group)
        return 0;
    int32_t known = find_key(&b->known, &keys->back), at = pending_of(b, known, &keys->back);
    if (at != NONE)
        return answered(b, row, at, ended);
    if (row->answer || known != NONE)
        return 0;
    known = find_key(&b->known, &keys->there);
    at = pending_of(b, known, &keys->there);
    if (at != NONE) {
        int completes = ((Pending *)payload(&b->pending, at))->half_open && row->flags & ACK && !(row->flags & (RST | SYN));
        if (completes)
            end_contact(b, at, row->time, 0, ended);
        return completes;
    }
    if (known == NONE && !(row->is_tcp && is_tcp_reply(row->flags)))
        begin_contact(b, row, sender, &keys->there);
    return 0;
}

#endif
