/* Addresses inside, kinds, and how `behaviour.c` counts, teaches and tells. */

#ifndef BEHAVIOUR_FINDINGS_H
#define BEHAVIOUR_FINDINGS_H

#include "behaviour_state.h"

static int is_inside(Address address)
{
    uint64_t hi = address.hi, lo = address.lo;
    if (is_six(address) && !hi && lo >> 32 == 0xFFFF)
        address = address_of(4, 0, lo & 0xFFFFFFFFu);
    uint32_t four = (uint32_t)address.lo;
    if (!is_six(address))
        return four >> 24 == 0 || four >> 24 == 10 || four >> 24 == 127 || four >> 16 == 0xA9FE || four >> 20 == 0xAC1
               || four >> 3 == 0xC0000000u >> 3 || four >> 1 == 0xC00000AAu >> 1 || four >> 8 == 0xC00002 || four >> 16 == 0xC0A8
               || four >> 17 == 0xC612 >> 1 || four >> 8 == 0xC63364 || four >> 8 == 0xCB0071 || four >> 28 == 0xF;
    return (!hi && lo <= 1) || hi == 0x0100000000000000u || hi >> 41 == 0x20010000u >> 9 || hi >> 32 == 0x20010DB8u
           || hi >> 57 == 0xFC >> 1 || hi >> 54 == 0xFE80 >> 6;
}

static int64_t protocol_of(int64_t service)
{
    return service & ~0xFFFFLL;
}

static uint64_t kind_of(int64_t service, int inside)
{
    return ((uint64_t)service << 1 | (uint64_t)(inside != 0)) + 1; /* 0: no kind */
}

static Address address_in(const Subject *sender)
{
    Address found = {sender->word[2], sender->word[3], sender->word[1] >> 16 & 1 ? 6 : 4};
    return found;
}

static Subject with_more(Subject sender, uint64_t more, Address target)
{
    sender.word[1] |= more << 32;
    sender.word[4] = target.hi;
    sender.word[5] = target.lo;
    return sender;
}

static inline Key keyed_by(const Behaviour *b, Subject subject)
{
    return keyed(&b->known, subject);
}

static const Address NOBODY = {0, 0, 0};

static inline int is_login(const Behaviour *b, int64_t service)
{
    int64_t port = service - TCP;
    return port >= 0 && port < 65536 && b->login_ports[port >> 3] >> (port & 7) & 1;
}

static inline Subject visit_of(Address source, Address host)
{
    return pair_of(is_six(host), 0, source, host);
}

static inline Subject login_of(Address source, Address target, int64_t service, int64_t reverse)
{
    return pair_of(join_ports((uint64_t)service, (uint64_t)reverse), is_six(source), source, target);
}

static void set_who(BehaviourEvent *event, const Subject *sender)
{
    event->has_sender = 1;
    memcpy(event->who, sender->word, sizeof event->who);
}

static void set_victim(BehaviourEvent *event, Address victim)
{
    /* two words: the version of the victim is that of the packet, kept beside the sender's in word 1 */
    event->victim[0] = victim.hi;
    event->victim[1] = victim.lo;
    event->who[1] |= (uint64_t)is_six(victim) << 17;
}

static void taught(Behaviour *b, int what, int block, const Subject *sender, Address victim, int64_t service, uint64_t kind, const double *sums)
{
    BehaviourEvent *event = new_event(b, what, block);
    if (!event)
        return;
    if (sender)
        set_who(event, sender);
    set_victim(event, victim);
    event->service = service;
    event->kind = kind;
    memcpy(event->sums, sums, (size_t)b->counter[what].set.windows * sizeof *sums);
}

static BehaviourEvent *found(Behaviour *b, int what, const Subject *sender, Address victim, int64_t service, const Seen *seen, double time, uint64_t arrival)
{
    BehaviourEvent *event = new_event(b, what, -1);
    if (!event)
        return NULL;
    if (sender)
        set_who(event, sender);
    set_victim(event, victim);
    event->service = service;
    event->nats = seen->nats;
    event->total = seen->total;
    event->count = seen->count;
    event->window = seen->window;
    event->usual = seen->usual;
    event->begun = seen->begun;
    event->time = time;
    event->arrival = arrival;
    return event;
}

static int count(Behaviour *b, int what, const Key *subject, double time, double weight, double *sums)
{
    if (counter_add(&b->counter[what], subject, time, weight, b->limits.most_subjects, sums))
        b->failed = 1;
    return b->failed;
}

/* Weighs sums of which the subject is also the name under which it is reported. */
static int weighed(Behaviour *b, int what, const Key *whose, const double *sums, uint64_t kind, double time, Seen *seen)
{
    *seen = counter_measure(&b->counter[what], &b->limits, whose, sums, kind);
    seen->nats = found_added(&b->counter[what].reported, &b->limits, whose, seen->total, time);
    return seen->nats != 0;
}

#endif
