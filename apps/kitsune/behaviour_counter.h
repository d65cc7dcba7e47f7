/* Sliding sums, the weight of what is above training, and what was reported: `baseline.py` and `findings.py` in C. */

#ifndef BEHAVIOUR_COUNTER_H
#define BEHAVIOUR_COUNTER_H

#include "hash_table.h"
#include <math.h>

#define MOST_WINDOWS 4
#define MOST_EVENTS 1024
#define NEAR_EVENTS 2 /* most subjects have no more */
#define FORGOTTEN_AT_A_TIME 2

/* Limits and constants, set by Python from the modules that define them. */
typedef struct {
    int32_t most_subjects, kept, most_contacts, calibration;
    double grace_s, least_nats, most_nats, least_step, least_share, deciding_nats, half_life_s, neighbours_share,
        least_scale_share, asked_s, present_s, theft, again_s, soon_s, in_vain_s;
    int32_t refused_bytes, replies_count, chosen, blocks, most_logins, others;
} BehaviourLimits;

typedef struct {
    int32_t windows, own, rates;
    double window[MOST_WINDOWS], least_scale;
} CounterSettings;

typedef struct {
    double nats, time;
} Reported;

/* Times of `room` events, then room + 1 sums, of which the i-th is that of all events before the i-th. */
typedef struct {
    double *far; /* NULL while they fit into `near` */
    int32_t count, room;
    int32_t first[MOST_WINDOWS]; /* by window: the first event within it, as of the latest */
    int32_t unordered; /* a time is no number: then the first event is searched */
    double near[2 * NEAR_EVENTS + 1];
} Events;

typedef struct {
    CounterSettings set;
    int usable;
    double own_scale, shared_scale, rarity;
    double begun[MOST_WINDOWS]; /* by window: the first event of the last sums, seconds; 0 where nothing is summed */
    int32_t quiet; /* the number of the oldest subject, if its latest event is known ... */
    double quiet_since; /* ... which was at this time */
    uint64_t shared_kind; /* the kind that was compared last, and its counts; only while `is_shared_known` */
    const double *shared_counts;
    int is_shared_known;
    Table events, shared, highest, reported;
} Counter;

typedef struct {
    double nats, total, count, window, usual, begun;
} Seen;

/* As fmax, which is a call. */
static inline double larger(double a, double b)
{
    return a >= b || b != b ? a : b;
}

static int counter_start(Counter *counter, const CounterSettings *set, uint64_t seed)
{
    counter->set = *set;
    counter->usable = set->windows;
    counter->own_scale = counter->shared_scale = 1;
    counter->quiet = NONE;
    size_t counts = MOST_WINDOWS * sizeof(double);
    return table_start(&counter->events, sizeof(Events), seed) | table_start(&counter->shared, counts, seed)
           | table_start(&counter->highest, counts, seed) | table_start(&counter->reported, sizeof(Reported), seed);
}

static void counter_end(Counter *counter)
{
    for (int32_t at = counter->events.oldest; at != NONE; at = head(&counter->events, at)->newer)
        free(((Events *)payload(&counter->events, at))->far);
    table_end(&counter->events);
    table_end(&counter->shared);
    table_end(&counter->highest);
    table_end(&counter->reported);
}

static int32_t first_not_before(const double *times, int32_t n, double time)
{
    int32_t low = 0, high = n;
    while (low < high) {
        int32_t middle = (low + high) / 2;
        if (times[middle] < time)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

static inline double *times_of(Events *events)
{
    return events->far ? events->far : events->near;
}

static int events_grow(Events *events)
{
    int32_t room = events->room ? events->room < 8 ? 8 : events->room * 2 : NEAR_EVENTS;
    if (events->room) {
        double *former = times_of(events), *far = malloc((2 * (size_t)room + 1) * sizeof *far);
        if (!far)
            return -1;
        memcpy(far, former, (size_t)events->count * sizeof *far);
        memcpy(far + room, former + events->room, ((size_t)events->count + 1) * sizeof *far);
        free(events->far);
        events->far = far;
    }
    events->room = room;
    return 0;
}

static void forget_oldest(Counter *counter)
{
    Table *table = &counter->events;
    free(((Events *)payload(table, table->oldest))->far);
    table_drop(table, table->oldest);
    counter->quiet = NONE;
}

/* Those that were quiet for longer than the longest window: their sums are 0, as are those of nobody. */
static void forget_quiet(Counter *counter, double time)
{
    Table *table = &counter->events;
    double since = time - counter->set.window[counter->set.windows - 1];
    for (int i = 0; i < FORGOTTEN_AT_A_TIME && table->oldest != NONE; i++) {
        if (counter->quiet != table->oldest) {
            Events *events = payload(table, table->oldest);
            counter->quiet = table->oldest;
            counter->quiet_since = events->count ? times_of(events)[events->count - 1] : INFINITY;
        }
        if (counter->quiet_since >= since)
            return;
        forget_oldest(counter);
    }
}

static Events *events_of(Counter *counter, const Key *subject, int32_t most)
{
    Table *table = &counter->events;
    int32_t at = find_key(table, subject);
    if (at != NONE) {
        if (at == counter->quiet)
            counter->quiet = NONE;
        table_renew(table, at);
        return payload(table, at);
    }
    if (table->live >= most)
        forget_oldest(counter);
    at = add_key(table, subject);
    return at == NONE ? NULL : payload(table, at);
}

/* Moves on to the first events within the windows that end at `time`; times never go back. */
static void find_firsts(const Counter *counter, Events *events, double time)
{
    const double *times = times_of(events);
    for (int i = 0; i < counter->set.windows; i++) {
        double since = time - counter->set.window[i];
        int32_t first = events->first[i];
        while (!events->unordered && first < events->count && times[first] < since)
            first++;
        events->first[i] = events->unordered ? first_not_before(times, events->count, since) : first;
    }
}

/* Forgets the oldest events, but only many at a time. */
static int drop_aged(const Counter *counter, Events *events)
{
    int32_t n = events->count, aged = events->first[counter->set.windows - 1];
    if (n > MOST_EVENTS && aged < MOST_EVENTS / 4)
        aged = MOST_EVENTS / 4;
    if (aged <= n / 8)
        return 0;
    double *times = times_of(events), *sums = times + events->room;
    n = events->count = n - aged;
    memmove(times, times + aged, (size_t)n * sizeof *times);
    memmove(sums, sums + aged, ((size_t)n + 1) * sizeof *sums);
    for (int i = 0; i < counter->set.windows; i++)
        events->first[i] = events->first[i] > aged ? events->first[i] - aged : 0;
    return 1;
}

/* Adds an event; the sums within the windows go to `out`.  -1 when memory is short. */
static int counter_add(Counter *counter, const Key *subject, double time, double weight, int32_t most, double *out)
{
    forget_quiet(counter, time);
    Events *events = events_of(counter, subject, most);
    if (!events || (events->count == events->room && events_grow(events)))
        return -1;
    double *times = times_of(events), *sums = times + events->room;
    int32_t n = events->count;
    if (n && time < times[n - 1])
        time = times[n - 1]; /* two ports may deliver in another order */
    events->unordered |= time != time;
    times[n] = time;
    sums[n + 1] = sums[n] + weight;
    events->count++;
    find_firsts(counter, events, time);
    if (drop_aged(counter, events) && events->unordered)
        find_firsts(counter, events, time);
    for (int i = 0; i < counter->set.windows; i++) {
        out[i] = sums[events->count] - sums[events->first[i]];
        counter->begun[i] = times[events->first[i]];
    }
    return 0;
}

static void weigh_more(const Counter *counter, int window, Seen *best, double nats, double count, double usual)
{
    if (nats > best->total) {
        Seen more = {0, nats, count, counter->set.window[window], usual, counter->begun[window]};
        *best = more;
    }
}

static const double *counts_of(const Table *table, const Key *key)
{
    int32_t at = find_key(table, key);
    return at == NONE ? NULL : payload(table, at);
}

/* The highest counts of a kind; one packet is seldom of another kind than the one before. */
static const double *shared_of(Counter *counter, uint64_t kind)
{
    if (!counter->is_shared_known || counter->shared_kind != kind) {
        Key by_kind = keyed(&counter->shared, (Subject){{kind, 0, 0, 0, 0, 0}});
        counter->shared_counts = counts_of(&counter->shared, &by_kind);
        counter->shared_kind = kind;
        counter->is_shared_known = 1;
    }
    return counter->shared_counts;
}

/* Nats of a count above everybody's highest, without its rarity. */
static double counter_excess(const Counter *counter, double count, double most)
{
    double least = counter->set.least_scale;
    if (counter->set.rates)
        return log((count + least) / (most + least)) / counter->shared_scale;
    return (count - most) / larger(least, counter->shared_scale * most);
}

static Seen counter_measure(Counter *counter, const BehaviourLimits *limits, const Key *whose, const double *sums, uint64_t kind)
{
    const double *shared = shared_of(counter, kind), *own = counts_of(&counter->highest, whose);
    Seen best = {0, 0, sums[0], counter->set.window[0], 0, counter->begun[0]};
    for (int i = 0; i < counter->usable; i++) {
        double count = sums[i], most = shared ? shared[i] : 0;
        if (count > most)
            weigh_more(counter, i, &best, counter->rarity + counter_excess(counter, count, most), count, most);
        if (own) {
            double usual = larger(own[i], limits->neighbours_share * most);
            if (count > usual) {
                double scale = larger(larger(counter->set.least_scale, counter->own_scale * usual), limits->least_scale_share * most);
                weigh_more(counter, i, &best, (count - usual) / scale, count, usual);
            }
        }
    }
    return best;
}

/* Whether too little is new, by a lower bound of what is left of the former nats: then no power need be computed. */
static int is_told(const BehaviourLimits *limits, double nats, double former, double half_lives)
{
    double left = former * (1 - 0.6932 * half_lives) * (1 - 1e-12); /* 0.5^x >= 1 - x ln 2 */
    double least = limits->least_share * larger(left, limits->deciding_nats);
    return nats - left < (left > limits->deciding_nats || least < limits->least_step ? least : limits->least_step);
}

/* The part that is new, if it is worth a message; else 0. */
static double found_added(Table *reported, const BehaviourLimits *limits, const Key *subject, double nats, double time)
{
    if (nats < limits->least_nats)
        return 0;
    nats = nats < limits->most_nats ? nats : limits->most_nats;
    int32_t at = find_key(reported, subject);
    double faded = 0;
    if (at != NONE) {
        const Reported *former = payload(reported, at);
        double half_lives = fmax(0.0, time - former->time) / limits->half_life_s;
        if (is_told(limits, nats, former->nats, half_lives))
            return 0;
        faded = former->nats * pow(0.5, half_lives);
    }
    double least = faded > limits->deciding_nats ? limits->least_share * faded : limits->least_step;
    if (nats < limits->least_nats || nats - faded < least)
        return 0;
    if (at == NONE) {
        if (reported->live >= limits->kept)
            table_drop(reported, reported->oldest);
        at = add_key(reported, subject);
        if (at == NONE)
            return 0;
    }
    Reported *now = payload(reported, at);
    now->nats = nats;
    now->time = time;
    return nats - faded;
}

#endif
