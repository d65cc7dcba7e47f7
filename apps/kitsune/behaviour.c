/* What senders do beyond training: `behaviour/behaviour.py` in C, with equal results.
 *
 *     rows ──► contacts, logins, exchanges, ARP, scores ──► Counter ──► BehaviourEvent
 *
 * Of training it returns sums, from which Python makes baselines; afterwards findings.
 */

#include "behaviour_findings.h"

typedef struct {
    Behaviour *b;
    const Row *row;
    const Keys *keys;
    Subject sender;
    int block;
} Turn;

/* ---- contacts that ended */

static int64_t flooded(const Ended *ended)
{
    if (protocol_of(ended->service) == UDP && ended->reverse - UDP < WELL_KNOWN)
        return FROM_UDP | (ended->reverse - UDP);
    if (protocol_of(ended->service) == TCP && !ended->is_syn)
        return STRAY_TCP | (ended->service - TCP);
    return ended->service;
}

/* Whether a contact failed because nobody reaches the outside; follows them. */
static int is_outside_down(Behaviour *b, const Ended *ended, int block)
{
    if (is_inside(ended->target) || !is_inside(address_in(&ended->sender)))
        return 0;
    if (!ended->failed) {
        table_clear(&b->in_vain);
        b->outside_reached |= block >= 0;
        return 0;
    }
    if (block >= 0)
        return 0;
    if (b->in_vain.live && ended->time - b->in_vain_since > b->limits.in_vain_s)
        table_clear(&b->in_vain);
    if (!b->in_vain.live)
        b->in_vain_since = ended->time;
    if (b->in_vain.live <= b->limits.others && table_find(&b->in_vain, &ended->sender) == NONE)
        added(b, &b->in_vain, &ended->sender);
    return (b->silence >= 0 && ended->time - b->outside_last > b->silence)
           || (b->outside_reached && b->in_vain.live > b->limits.others);
}

/* What ended, by the service that it counts for. */
static void contact_views(Behaviour *b, const Ended *ended, int64_t service, int counts, int block)
{
    const Subject *sender = &ended->sender;
    int inside = is_inside(address_in(sender));
    int64_t protocol = protocol_of(service);
    int64_t named = (service & 0xFFFF) < b->limits.chosen ? service : protocol | b->limits.chosen;
    Key whose = keyed_by(b, with_more(*sender, (uint64_t)protocol, NOBODY));
    struct {
        Key subject;
        uint64_t kind;
        Address victim;
        int64_t single;
    } view[3] = {
        {whose, kind_of(protocol, inside), NOBODY, NO_SERVICE},
        {keyed_by(b, with_more(*sender, 0, ended->target)), kind_of(protocol, inside), ended->target, NO_SERVICE},
        {keyed_by(b, with_more(*sender, (uint64_t)service, NOBODY)), kind_of(named, inside), NOBODY, service},
    };
    fetch_slot(&b->counter[PORTS].events, view[PORTS].subject.hash);
    fetch_slot(&b->counter[TARGETS].events, view[TARGETS].subject.hash);
    int which = NONE;
    Seen best = {0};
    for (int what = service == UNANSWERED ? TARGETS : CONTACTS; what <= TARGETS; what++) {
        double sums[MOST_WINDOWS];
        if (count(b, what, &view[what].subject, ended->time, counts ? 1.0 : -1.0, sums))
            return;
        if (block >= 0)
            taught(b, what, block, sender, NOBODY, protocol, view[what].kind, sums);
        else if (counts) {
            Seen seen = counter_measure(&b->counter[what], &b->limits, &whose, sums, view[what].kind);
            if (seen.total >= b->limits.least_nats && (which == NONE || seen.total >= best.total)) {
                best = seen;
                which = what;
            }
        }
    }
    if (which == NONE)
        return;
    Key reported = keyed_by(b, *sender);
    best.nats = found_added(&b->failures, &b->limits, &reported, best.total, ended->time);
    if (best.nats)
        found(b, which, sender, view[which].victim, view[which].single, &best, ended->time, ended->arrival);
}

static void contact_made(Behaviour *b, const Ended *ended, int block)
{
    if (is_outside_down(b, ended, block))
        return;
    int pinged = ended->service == ECHO;
    /* hosts answer echo requests of everybody: that they do makes up for nothing */
    contact_views(b, ended, ended->service, ended->failed || pinged, block);
    if (ended->failed && pinged)
        contact_views(b, ended, UNANSWERED, 1, block);
}

static void count_stranger(Behaviour *b, Address victim, int64_t what, const Ended *ended, int block)
{
    Key key = keyed_by(b, pair_of((uint32_t)what, is_six(victim), victim, NOBODY));
    double sums[MOST_WINDOWS];
    Seen seen;
    if (count(b, STRANGERS, &key, ended->time, 1.0, sums))
        return;
    if (block >= 0)
        taught(b, STRANGERS, block, NULL, victim, what, 0, sums);
    else if (weighed(b, STRANGERS, &key, sums, 0, ended->time, &seen))
        found(b, STRANGERS, NULL, victim, what, &seen, ended->time, ended->arrival);
}

static int is_fresh_stranger(Behaviour *b, Subject stranger)
{
    Key key = keyed_by(b, stranger);
    if (find_key(&b->strangers, &key) != NONE)
        return 0;
    if (b->strangers.live >= b->limits.kept)
        table_clear(&b->strangers);
    added_key(b, &b->strangers, &key);
    return 1;
}

static void strange(Behaviour *b, const Ended *ended, int block)
{
    Address source = address_in(&ended->sender), target = ended->target;
    Subject known = pair_of(is_six(source), 0, source, NOBODY);
    if (block < 0 && table_find(&b->owners, &known) != NONE)
        return;
    int64_t what = flooded(ended);
    if (!is_fresh_stranger(b, pair_of((uint32_t)what, is_six(source), source, target)))
        return;
    count_stranger(b, target, what, ended, block);
    if (protocol_of(what) != UDP)
        return;
    Subject everywhere = pair_of(ANY_UDP, is_six(source), source, target), port = pair_of(ANY_UDP, 2 | (uint64_t)is_six(target) | (uint64_t)what << 32, NOBODY, target);
    if (is_fresh_stranger(b, everywhere) && is_fresh_stranger(b, port))
        count_stranger(b, target, ANY_UDP, ended, block);
}

/* FTP's data connections and ident connect back by design. */
static int is_by_design(int64_t service)
{
    return service == (TCP | 20) || service == (TCP | 113);
}

static void callback(Behaviour *b, const Ended *ended)
{
    if (ended->service >> 16 != TCP >> 16 || is_by_design(ended->service) || is_by_design(ended->reverse))
        return;
    Address host = address_in(&ended->sender);
    Subject key = visit_of(ended->target, host);
    int32_t at = table_find(&b->visits, &key);
    if (at == NONE)
        return;
    Visit visit = *(Visit *)payload(&b->visits, at);
    if (ended->time - visit.time > b->limits.soon_s)
        return;
    Key whose = keyed_by(b, visit.sender);
    double after = ended->time - visit.time, added = found_added(&b->called, &b->limits, &whose, b->callback_nats, ended->time);
    Seen seen = {added, b->callback_nats, 1, after, b->callback_usual, ended->time - after};
    if (seen.nats)
        found(b, CALLBACKS, &visit.sender, host, visit.service, &seen, ended->time, ended->arrival);
}

static void visited(Behaviour *b, const Subject *sender, const Key *key, int64_t service, double time)
{
    int32_t at = find_key(&b->visits, key);
    Visit *visit = at != NONE ? payload(&b->visits, at) : added_key(b, &b->visits, key);
    if (!visit)
        return;
    Visit now = {*sender, service, time};
    *visit = now;
    if (b->visits.live > b->limits.most_logins)
        table_drop(&b->visits, b->visits.oldest);
}

static void contact_ended(Behaviour *b, const Ended *ended, int block)
{
    int is_reflected = protocol_of(flooded(ended)) == FROM_UDP && !is_inside(address_in(&ended->sender));
    if (!(ended->failed && ended->half_open) && !is_reflected)
        contact_made(b, ended, block);
    if (ended->failed)
        strange(b, ended, block);
    else if (block < 0)
        callback(b, ended);
}

static void ping(Turn *t)
{
    const Row *row = t->row;
    if (row->service != ECHO || row->answer || row->group || row->quoted || !is_some(row->source))
        return;
    Ended asked = {1, row->time, t->sender, row->source, row->target, ECHO, ECHO, 0, 0, row->arrival};
    strange(t->b, &asked, t->block);
}

/* ---- logins */

static double login_change(const Behaviour *b, Login *login, const Row *row, uint32_t length)
{
    if (login->settled)
        return 0;
    login->moved += length;
    int is_long = login->moved >= b->limits.refused_bytes;
    login->settled = is_long || row->flags & (RST | FIN);
    return !login->settled ? 0 : is_long ? -0.5 : 0.5;
}

static double login_weight(Turn *t, const Key *key, uint32_t length, Subject *who)
{
    Behaviour *b = t->b;
    int32_t at = find_key(&b->logins, key);
    if (at != NONE) {
        Login *login = payload(&b->logins, at);
        *who = login->sender;
        return login_change(b, login, t->row, length);
    }
    if ((t->row->flags & (SYN | ACK | RST | FIN)) != SYN)
        return 0;
    if (b->logins.live >= b->limits.kept)
        table_clear(&b->logins);
    Login *login = added_key(b, &b->logins, key);
    if (!login)
        return 0;
    login->sender = *who = t->sender;
    login->moved = length;
    return 0.5;
}

static void login(Turn *t)
{
    Behaviour *b = t->b;
    const Row *row = t->row;
    if (!row->is_tcp || row->quoted)
        return;
    int by_server = !t->keys->is_login;
    if (by_server && (!(row->flags & (RST | FIN)) || !is_login(b, row->reverse)))
        return;
    Address source = by_server ? row->target : row->source, target = by_server ? row->source : row->target;
    int64_t service = by_server ? row->reverse : row->service, reverse = by_server ? row->service : row->reverse;
    Key key = by_server ? keyed_by(b, login_of(source, target, service, reverse)) : t->keys->login;
    Subject who;
    double weight = login_weight(t, &key, by_server ? 0 : row->length, &who), sums[MOST_WINDOWS];
    if (!weight)
        return;
    Key subject = keyed_by(b, with_more(who, (uint64_t)service, target)), whose = keyed_by(b, with_more(who, (uint64_t)service, NOBODY));
    uint64_t kind = kind_of(service, is_inside(source));
    if (count(b, LOGINS, &subject, row->time, weight, sums))
        return;
    if (t->block >= 0) {
        taught(b, LOGINS, t->block, &who, NOBODY, service, kind, sums);
        return;
    }
    Seen seen = counter_measure(&b->counter[LOGINS], &b->limits, &whose, sums, kind);
    if (seen.total >= b->limits.least_nats) {
        Key visit = by_server ? keyed_by(b, visit_of(source, target)) : t->keys->visit;
        visited(b, &who, &visit, service, row->time);
    }
    Key reported = keyed_by(b, who);
    seen.nats = found_added(&b->counter[LOGINS].reported, &b->limits, &reported, seen.total, row->time);
    if (seen.nats)
        found(b, LOGINS, &who, target, service, &seen, row->time, row->arrival);
}

/* ---- one-way traffic */

/* Both directions between the hosts of a packet: the entry, and which half is that of its sender. */
static Exchanges *exchanges_of(Turn *t, int *mine, int make)
{
    Table *table = &t->b->exchanges;
    int32_t at = find_key(table, &t->keys->hosts);
    *mine = !comes_first(t->row->source, t->row->target);
    if (at != NONE)
        return payload(table, at);
    return make ? added_key(t->b, table, &t->keys->hosts) : NULL;
}

static Exchange *begun_exchange(Turn *t, Exchange *half, int *mine)
{
    Behaviour *b = t->b;
    if (half->is_there)
        return half;
    if (b->exchange_halves >= b->limits.kept) {
        table_clear(&b->exchanges);
        b->exchange_halves = 0;
        Exchanges *both = exchanges_of(t, mine, 1);
        if (!both)
            return NULL;
        half = &both->half[*mine];
    }
    b->exchange_halves++;
    half->is_there = 1;
    half->second = -1;
    return half;
}

static void learn_one_way(Turn *t, int64_t kind, int64_t alone)
{
    int number = kind == TCP ? 0 : kind == UDP ? 1 : kind == ECHO ? 2 : kind == OPENING ? 3 : NONE;
    double sums[MOST_WINDOWS] = {(double)alone};
    if (number != NONE) { /* of a block only the highest counts matter */
        double *most = &t->b->one_way_most[number][t->block];
        if (!(sums[0] > *most))
            return;
        *most = sums[0];
    }
    taught(t->b, ONE_WAY, t->block, &t->sender, NOBODY, kind, (uint64_t)kind << 1 | 1, sums);
}

static void one_way(Turn *t)
{
    const Row *row = t->row;
    Behaviour *b = t->b;
    if (row->group || row->quoted || !is_some(row->source) || row->service >= ARP)
        return;
    int mine, refused = row->answer || (row->is_tcp && is_tcp_reply(row->flags));
    Exchanges *both = exchanges_of(t, &mine, !refused);
    if (!both)
        return;
    Exchange *back = same_address(row->source, row->target) ? &both->half[mine] : &both->half[!mine];
    if (back->is_there && back->second == row->second && !refused)
        back->back++;
    if (refused)
        return;
    Exchange *here = begun_exchange(t, &both->half[mine], &mine);
    if (!here)
        return;
    if (here->second != row->second) {
        here->before = here->second == row->second - 1 ? here->back : 0;
        here->second = row->second;
        here->out = here->back = here->due = here->syns = here->syns_due = 0;
    }
    int opening = row->is_tcp && row->flags & SYN;
    int64_t *due = opening ? &here->syns_due : &here->due, kind = opening ? OPENING : protocol_of(row->service);
    ++*(opening ? &here->syns : &here->out);
    int64_t alone = opening ? here->syns - here->out : here->out - b->limits.replies_count * (here->back + here->before);
    if (t->block >= 0) {
        learn_one_way(t, kind, alone);
        return;
    }
    if (alone < *due)
        return;
    *due = alone + (alone >= 8 ? alone / 8 : 1);
    double sums[MOST_WINDOWS] = {(double)alone};
    Key whose = keyed_by(b, with_more(t->sender, (uint64_t)kind, NOBODY));
    Seen seen = counter_measure(&b->counter[ONE_WAY], &b->limits, &whose, sums, (uint64_t)kind << 1 | 1);
    Key sender = keyed_by(b, t->sender);
    seen.nats = found_added(&b->counter[ONE_WAY].reported, &b->limits, &sender, seen.total, row->time);
    seen.begun = (double)row->second;
    if (seen.nats)
        found(b, ONE_WAY, &t->sender, row->target, row->service, &seen, row->time, row->arrival);
}

/* ---- ARP */

static void count_claim(Turn *t, int what, Address victim, double weight)
{
    const Row *row = t->row;
    Subject who = t->sender;
    double sums[MOST_WINDOWS];
    Seen seen;
    who.word[1] &= 0xFFFF;
    who.word[2] = who.word[3] = 0; /* it may claim several addresses */
    Key key = keyed_by(t->b, who);
    if (count(t->b, what, &key, row->time, weight, sums))
        return;
    if (t->block >= 0)
        taught(t->b, what, t->block, &who, NOBODY, NO_SERVICE, 0, sums);
    else if (weighed(t->b, what, &key, sums, 0, row->time, &seen))
        found(t->b, what, &who, victim, row->service, &seen, row->time, row->arrival);
}

static void theft(Turn *t)
{
    Behaviour *b = t->b;
    const Row *row = t->row;
    if (t->block >= 0 || !is_some(row->source))
        return;
    Subject address = pair_of(0, 0, row->source, NOBODY), owner = pair_of(0, row->mac, row->source, NOBODY);
    int32_t at = table_find(&b->owners, &address);
    if (at == NONE || table_find(&b->owner_macs, &owner) != NONE)
        return;
    if (row->time - *(double *)payload(&b->owners, at) > b->limits.present_s)
        return;
    count_claim(t, THEFTS, row->source, b->limits.theft);
}

static void arp(Turn *t)
{
    Behaviour *b = t->b;
    const Row *row = t->row;
    if (row->service != ARP)
        return;
    theft(t);
    if (row->answer) {
        Subject key = pair_of(0, 0, row->target, row->source);
        int32_t at = table_find(&b->asked, &key);
        if (at == NONE || !(row->time - *(double *)payload(&b->asked, at) <= b->limits.asked_s))
            count_claim(t, CLAIMS, row->target, 1.0);
        return;
    }
    Subject key = pair_of(0, 0, row->source, row->target);
    if (b->asked.live >= b->limits.kept)
        table_clear(&b->asked);
    int32_t at = table_find(&b->asked, &key);
    double *time = at != NONE ? payload(&b->asked, at) : added(b, &b->asked, &key);
    if (time)
        *time = row->time;
}

static void spoke(Turn *t)
{
    const Row *row = t->row;
    if (!is_some(row->source))
        return;
    int32_t at = find_key(&t->b->owner_macs, &t->keys->owner);
    if (at != NONE)
        *(double *)payload(&t->b->owners, *(int32_t *)payload(&t->b->owner_macs, at)) = row->time;
}

/* ---- scores */

static void score(Turn *t, const Key *sender, double log)
{
    Behaviour *b = t->b;
    const Row *row = t->row;
    double sums[MOST_WINDOWS];
    Seen seen;
    if (count(b, SCORES, sender, row->time, log, sums) || !weighed(b, SCORES, sender, sums, 0, row->time, &seen))
        return;
    int supporting = came_about(b, &t->keys->there) || came_about(b, &t->keys->back) || row->group || find_key(&b->senders, sender) != NONE;
    BehaviourEvent *event = found(b, SCORES, &t->sender, row->target, row->service, &seen, row->time, row->arrival);
    if (event)
        event->supporting = supporting;
}

static void over(Turn *t, const Key *sender, double score)
{
    Behaviour *b = t->b;
    const Row *row = t->row;
    int32_t at = find_key(&b->told, sender);
    if (at != NONE && row->time - *(double *)payload(&b->told, at) < b->limits.again_s)
        return;
    if (b->told.live >= b->limits.kept) {
        table_clear(&b->told);
        at = NONE;
    }
    double *time = at != NONE ? payload(&b->told, at) : added_key(b, &b->told, sender);
    if (!time)
        return;
    *time = row->time;
    Seen seen = {0, 0, score, 0, 0, row->time};
    BehaviourEvent *event = found(b, THRESHOLD, &t->sender, row->target, row->service, &seen, row->time, row->arrival);
    if (event)
        event->supporting = 1;
}

/* ---- training */

static void know_owner(Behaviour *b, Address address, uint64_t mac, const Subject *sender)
{
    Subject by_address = pair_of(is_six(address), 0, address, NOBODY), owner = pair_of(is_six(address), mac, address, NOBODY);
    if (table_find(&b->owner_macs, &owner) != NONE)
        return;
    int32_t at = table_find(&b->owners, &by_address);
    if (at == NONE) {
        at = table_add(&b->owners, &by_address);
        if (at == NONE) {
            b->failed = 1;
            return;
        }
        *(double *)payload(&b->owners, at) = -INFINITY;
    }
    int32_t *number = added(b, &b->owner_macs, &owner);
    if (!number)
        return;
    *number = at;
    BehaviourEvent *event = sender ? new_event(b, NEW_OWNER, -1) : NULL;
    if (event)
        set_who(event, sender);
}

static int train(Turn *t)
{
    Behaviour *b = t->b;
    const Row *row = t->row;
    int64_t block = b->packets / b->per_block;
    if (!b->packets++)
        b->begun = row->time;
    b->seconds = fmax(row->time - b->begun, 1.0);
    Key sender = keyed_by(b, t->sender);
    if (find_key(&b->senders, &sender) == NONE && added_key(b, &b->senders, &sender)) {
        BehaviourEvent *event = new_event(b, NEW_SENDER, -1);
        if (event)
            set_who(event, &t->sender);
    }
    if (is_some(row->source))
        know_owner(b, row->source, row->mac, &t->sender);
    int64_t most = b->limits.calibration;
    Trained last = {t->sender, row->time};
    b->tail[(b->tail_from + b->tail_count) % most] = last;
    if (b->tail_count < most)
        b->tail_count++;
    else
        b->tail_from = (b->tail_from + 1) % most;
    return block < b->limits.blocks ? (int)block : b->limits.blocks - 1;
}

/* The longest silence of the outside, while training lasts. */
static void hear_outside(Turn *t)
{
    Behaviour *b = t->b;
    const Row *row = t->row;
    if (b->outside_last == -INFINITY)
        b->outside_last = row->time;
    if (!is_some(row->source) || is_inside(row->source))
        return;
    b->outside_heard = 1;
    b->outside_gap = fmax(b->outside_gap, row->time - b->outside_last);
    b->outside_last = fmax(b->outside_last, row->time);
}

static void follow(Turn *t)
{
    Ended ended;
    while (next_due(t->b, t->row->time, &ended))
        contact_ended(t->b, &ended, t->block);
    if (follow_contact(t->b, t->row, &t->sender, t->keys, &ended))
        contact_ended(t->b, &ended, t->block);
    login(t);
    one_way(t);
    ping(t);
    arp(t);
    spoke(t);
    hear_outside(t);
}

/* A packet of training where `scored` is NULL. */
static void take_row(Behaviour *b, const Row *row, const Keys *keys, uint16_t number, const double *scored, double log, double threshold)
{
    Turn turn = {b, row, keys, sender_of(number, row, row->source, 0), -1};
    if (!scored)
        turn.block = train(&turn);
    if (is_blocked(&b->blocked, number, row->to_mac, row->target))
        return;
    follow(&turn);
    if (!(log > 0))
        return;
    Key sender = keyed_by(b, turn.sender);
    score(&turn, &sender, log);
    if (*scored >= threshold)
        over(&turn, &sender, *scored);
}

#include "behaviour_prefetch.h"

/* ---- the interface */

/* Rows first to last; they train where `logs` is NULL.  -1 when memory is short, -2 for rows out of range. */
int behaviour_add(Behaviour *b, const Row *rows, long n, long first, long last, uint16_t number, const double *scores, const double *logs, double threshold)
{
    if (first < 0 || last < first || last > n)
        return -2;
    b->event_count = 0;
    Keys ahead[AHEAD];
    for (long i = first; i < last && i < first + AHEAD; i++)
        look_ahead(b, &rows[i], number, &ahead[i % AHEAD]);
    for (long i = first; i < last && !b->failed; i++) {
        if (i + AHEAD / 2 < last)
            fetch_entries(b, &ahead[(i + AHEAD / 2) % AHEAD]);
        take_row(b, &rows[i], &ahead[i % AHEAD], number, logs ? scores + i : NULL, logs ? logs[i] : 0, threshold);
        if (i + AHEAD < last)
            look_ahead(b, &rows[i + AHEAD], number, &ahead[i % AHEAD]);
    }
    return b->failed ? -1 : 0;
}

#include "behaviour_setup.h"

#include "behaviour_dump.h"
