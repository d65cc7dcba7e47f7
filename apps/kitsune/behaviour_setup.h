/* Making and filling what `behaviour.c` works on: at the beginning, at the end of training, and from a model file. */

#ifndef BEHAVIOUR_SETUP_H
#define BEHAVIOUR_SETUP_H

void behaviour_free(Behaviour *b)
{
    if (!b)
        return;
    for (int what = 0; what < STATISTICS; what++)
        counter_end(&b->counter[what]);
    Table *tables[] = {&b->failures, &b->called, &b->visits, &b->pending, &b->known, &b->vain, &b->proven, &b->senders, &b->owners, &b->owner_macs,
                       &b->exchanges, &b->asked, &b->logins, &b->strangers, &b->told, &b->blocked, &b->in_vain};
    for (size_t i = 0; i < sizeof tables / sizeof *tables; i++)
        table_end(tables[i]);
    for (int which = 0; which < 2; which++)
        free(b->dues[which].due);
    free(b->tail);
    free(b->events);
    free(b);
}

static int start_tables(Behaviour *b, const CounterSettings *settings, uint64_t seed)
{
    int failed = 0;
    for (int what = 0; what < STATISTICS; what++)
        failed |= counter_start(&b->counter[what], &settings[what], seed);
    return failed | table_start(&b->failures, sizeof(Reported), seed) | table_start(&b->called, sizeof(Reported), seed)
           | table_start(&b->visits, sizeof(Visit), seed) | table_start(&b->pending, sizeof(Pending), seed)
           | table_start(&b->known, sizeof(Known), seed) | table_start(&b->vain, 0, seed) | table_start(&b->proven, 0, seed)
           | table_start(&b->senders, 0, seed) | table_start(&b->owners, sizeof(double), seed)
           | table_start(&b->owner_macs, sizeof(int32_t), seed) | table_start(&b->exchanges, sizeof(Exchanges), seed)
           | table_start(&b->asked, sizeof(double), seed) | table_start(&b->logins, sizeof(Login), seed)
           | table_start(&b->strangers, 0, seed) | table_start(&b->told, sizeof(double), seed) | table_start(&b->blocked, 0, seed)
           | table_start(&b->in_vain, 0, seed);
}

/* NULL when memory is short or a limit makes no sense. */
Behaviour *behaviour_new(const BehaviourLimits *limits, const CounterSettings *settings, int64_t per_block, const uint16_t *logins, long n, uint64_t seed)
{
    Behaviour *b = calloc(1, sizeof *b);
    if (!b)
        return NULL;
    b->limits = *limits;
    b->per_block = per_block < 1 ? 1 : per_block;
    b->generation = 1;
    b->seconds = 1;
    int bad = limits->blocks < 1 || limits->blocks > MOST_BLOCKS || limits->calibration < 1 || limits->most_subjects < 1 || limits->kept < 1
              || limits->most_contacts < 1;
    for (int what = 0; what < STATISTICS; what++)
        bad |= settings[what].windows < 1 || settings[what].windows > MOST_WINDOWS;
    if (!bad)
        b->tail = calloc((size_t)limits->calibration, sizeof *b->tail);
    if (bad || !b->tail || start_tables(b, settings, seed)) {
        behaviour_free(b);
        return NULL;
    }
    for (long i = 0; i < n; i++)
        b->login_ports[logins[i] >> 3] |= (uint8_t)(1 << (logins[i] & 7));
    b->outside_last = -INFINITY;
    b->silence = -1;
    b->learning = 1;
    b->arp_grace = limits->grace_s;
    for (int kind = 0; kind < 4; kind++)
        for (int block = 0; block < MOST_BLOCKS; block++)
            b->one_way_most[kind][block] = -INFINITY;
    return b;
}

const BehaviourEvent *behaviour_events(const Behaviour *b, long *count)
{
    *count = b->event_count;
    return b->events;
}

/* Whose events are counted, by each statistic. */
long behaviour_subjects(const Behaviour *b)
{
    long live = 0;
    for (int what = 0; what < STATISTICS; what++)
        live += b->counter[what].events.live;
    return live;
}

/* How many of the last packets of training are known. */
long behaviour_tail(const Behaviour *b)
{
    return (long)b->tail_count;
}

/* begun, seconds, the longest silence of the outside (-1 where it was not heard), whether somebody reached it, ARP
 * requests that were answered, the longest wait for a reply */
void behaviour_training(const Behaviour *b, double *out)
{
    out[0] = b->begun;
    out[1] = b->seconds;
    out[3] = b->outside_reached;
    out[4] = (double)b->arp_replies;
    out[5] = b->slowest_arp;
    out[2] = b->outside_heard ? fmax(b->outside_gap, b->begun + b->seconds - b->outside_last) : -1;
}

/* Training is done: the longest silence of the outside, and whether somebody reached it. */
void behaviour_outside(Behaviour *b, double silence, int32_t reached)
{
    b->silence = silence;
    b->outside_reached = reached;
}

/* The scores of the last packets of training; logs[i] is that of the i-th of the last n. */
int behaviour_calibrate(Behaviour *b, const double *logs, long n, int32_t blocks)
{
    b->event_count = 0;
    if (n > b->tail_count)
        return -2;
    long per_block = (n + blocks - 1) / blocks > 1 ? (n + blocks - 1) / blocks : 1;
    for (long i = 0; i < n && !b->failed; i++) {
        const Trained *each = &b->tail[(b->tail_from + b->tail_count - n + i) % b->limits.calibration];
        double sums[MOST_WINDOWS];
        Key sender = keyed_by(b, each->sender);
        if (logs[i] > 0 && !count(b, SCORES, &sender, each->time, logs[i], sums))
            taught(b, SCORES, (int)(i / per_block), &each->sender, NOBODY, NO_SERVICE, 0, sums);
    }
    b->tail_count = b->tail_from = 0;
    return b->failed ? -1 : 0;
}

/* Seconds to wait for ARP replies from now on. */
void behaviour_arp_grace(Behaviour *b, double seconds)
{
    b->learning = 0;
    b->arp_grace = seconds;
}

/* What is known by now is never counted again. */
void behaviour_close_training(Behaviour *b)
{
    for (int32_t at = b->known.oldest; at != NONE; at = head(&b->known, at)->newer)
        ((Known *)payload(&b->known, at))->generation = FROM_TRAINING;
    b->young = 0;
}

static int put_counts(Table *table, const uint64_t *key, const double *counts)
{
    Subject subject;
    memcpy(&subject, key, sizeof subject);
    int32_t at = table_find(table, &subject);
    if (at == NONE)
        at = table_add(table, &subject);
    if (at == NONE)
        return -1;
    memcpy(payload(table, at), counts, MOST_WINDOWS * sizeof *counts);
    return 0;
}

/* A baseline: n rows of six words and four counts each, of subjects (`own`) or kinds. */
int behaviour_baseline(Behaviour *b, int32_t what, int32_t own, const uint64_t *keys, const double *counts, long n)
{
    if (what < 0 || what >= STATISTICS)
        return -2;
    Table *table = own ? &b->counter[what].highest : &b->counter[what].shared;
    b->counter[what].is_shared_known = 0;
    table_clear(table);
    for (long i = 0; i < n; i++)
        if (put_counts(table, keys + WORDS * i, counts + MOST_WINDOWS * i))
            return -1;
    return 0;
}

int behaviour_scales(Behaviour *b, int32_t what, int32_t usable, double own, double shared, double rarity)
{
    if (what < 0 || what >= STATISTICS || usable < 1 || usable > b->counter[what].set.windows)
        return -2;
    b->counter[what].usable = usable;
    b->counter[what].own_scale = own;
    b->counter[what].shared_scale = shared;
    b->counter[what].rarity = rarity;
    return 0;
}

/* Senders, owners of addresses, contacts of a training: six words each, as `sender_of`, `know_owner`, `contact_of`. */
int behaviour_know(Behaviour *b, const uint64_t *senders, long n, const uint64_t *owners, long m, const uint64_t *contacts, long k)
{
    Subject key;
    for (long i = 0; i < n; i++) {
        memcpy(&key, senders + WORDS * i, sizeof key);
        if (table_find(&b->senders, &key) == NONE)
            added(b, &b->senders, &key);
    }
    for (long i = 0; i < m; i++, owners += WORDS) {
        Address address = {owners[2], owners[3], owners[0] ? 6 : 4};
        know_owner(b, address, owners[1], NULL);
    }
    for (long i = 0; i < k; i++) {
        memcpy(&key, contacts + WORDS * i, sizeof key);
        Key contact = keyed_by(b, key);
        if (find_key(&b->known, &contact) == NONE)
            know_contact(b, &contact, FROM_TRAINING);
    }
    return b->failed ? -1 : 0;
}

/* The contacts of training, or those that came about: writes up to `room` of six words each, returns how many there are. */
long behaviour_contacts(const Behaviour *b, int32_t training, uint64_t *out, long room)
{
    long count = 0;
    for (int32_t at = b->known.oldest; at != NONE; at = head(&b->known, at)->newer) {
        Key contact = {head(&b->known, at)->key, head(&b->known, at)->hash};
        if (training ? ((const Known *)payload(&b->known, at))->generation != FROM_TRAINING : !came_about(b, &contact))
            continue;
        if (count < room)
            memcpy(out + WORDS * count, &contact.subject, sizeof contact.subject);
        count++;
    }
    return count;
}

/* What a callback weighs, and how many of training there were. */
void behaviour_callbacks(Behaviour *b, double nats, double usual)
{
    b->callback_nats = nats;
    b->callback_usual = usual;
}

int behaviour_proven(const Behaviour *b, int32_t six, uint64_t hi, uint64_t lo)
{
    Subject key = pair_of(six != 0, 0, (Address){hi, lo, six ? 6 : 4}, (Address){0, 0, 0});
    return table_find(&b->proven, &key) != NONE;
}

int behaviour_blocks(Behaviour *b, const uint64_t *rows, long n)
{
    return take_blocks(&b->blocked, rows, n);
}

#endif
