/* Sliding sums, the weight of what is above training, and what was reported: `baseline.py` and `findings.py` in C. */

#ifndef LEDGER_COUNTER_H
#define LEDGER_COUNTER_H

#include "ledger_table.h"
#include <math.h>

#define MOST_WINDOWS 4
#define MOST_EVENTS 1024
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

typedef struct {
    double *times, *sums; /* sums[i]: of all events before the i-th */
    int32_t count, room;
} Events;

typedef struct {
    CounterSettings set;
    int usable;
    double own_scale, shared_scale, rarity;
    double begun[MOST_WINDOWS]; /* by window: the first event of the last sums, seconds; 0 where nothing is summed */
    Table events, shared, highest, reported;
} Counter;

typedef struct {
    double nats, total, count, window, usual, begun;
} Seen;

static int counter_start(Counter *counter, const CounterSettings *set, uint64_t seed)
{
    counter->set = *set;
    counter->usable = set->windows;
    counter->own_scale = counter->shared_scale = 1;
    size_t counts = MOST_WINDOWS * sizeof(double);
    return table_start(&counter->events, sizeof(Events), seed) | table_start(&counter->shared, counts, seed)
           | table_start(&counter->highest, counts, seed) | table_start(&counter->reported, sizeof(Reported), seed);
}

static void events_end(Events *events)
{
    free(events->times);
    free(events->sums);
}

static void counter_end(Counter *counter)
{
    for (int32_t at = counter->events.oldest; at != NONE; at = head(&counter->events, at)->newer)
        events_end(payload(&counter->events, at));
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

static int events_grow(Events *events)
{
    if (events->count < events->room)
        return 0;
    int32_t room = events->room ? events->room * 2 : 8;
    double *times = realloc(events->times, (size_t)room * sizeof *times);
    if (!times)
        return -1;
    events->times = times;
    double *sums = realloc(events->sums, ((size_t)room + 1) * sizeof *sums);
    if (!sums)
        return -1;
    if (!events->sums)
        sums[0] = 0;
    events->sums = sums;
    events->room = room;
    return 0;
}

static void forget_oldest(Table *table)
{
    events_end(payload(table, table->oldest));
    table_drop(table, table->oldest);
}

/* Those that were quiet for longer than the longest window: their sums are 0, as are those of nobody. */
static void forget_quiet(Counter *counter, double time)
{
    Table *table = &counter->events;
    double since = time - counter->set.window[counter->set.windows - 1];
    for (int i = 0; i < FORGOTTEN_AT_A_TIME && table->oldest != NONE; i++) {
        const Events *events = payload(table, table->oldest);
        if (!events->count || events->times[events->count - 1] >= since)
            return;
        forget_oldest(table);
    }
}

static Events *events_of(Counter *counter, const Subject *subject, int32_t most)
{
    Table *table = &counter->events;
    int32_t at = table_find(table, subject);
    if (at != NONE) {
        table_renew(table, at);
        return payload(table, at);
    }
    if (table->live >= most)
        forget_oldest(table);
    at = table_add(table, subject);
    return at == NONE ? NULL : payload(table, at);
}

/* Adds an event; the sums within the windows go to `out`.  -1 when memory is short. */
static int counter_add(Counter *counter, const Subject *subject, double time, double weight, int32_t most, double *out)
{
    forget_quiet(counter, time);
    Events *events = events_of(counter, subject, most);
    if (!events || events_grow(events))
        return -1;
    if (events->count && time < events->times[events->count - 1])
        time = events->times[events->count - 1]; /* two ports may deliver in another order */
    events->times[events->count] = time;
    events->sums[events->count + 1] = events->sums[events->count] + weight;
    events->count++;
    int32_t n = events->count;
    int32_t aged = first_not_before(events->times, n, time - counter->set.window[counter->set.windows - 1]);
    if (n > MOST_EVENTS && aged < MOST_EVENTS / 4)
        aged = MOST_EVENTS / 4;
    if (aged > n / 8) {
        n = events->count = n - aged;
        memmove(events->times, events->times + aged, (size_t)n * sizeof *events->times);
        memmove(events->sums, events->sums + aged, ((size_t)n + 1) * sizeof *events->sums);
    }
    for (int32_t i = 0; i < counter->set.windows; i++) {
        int32_t first = first_not_before(events->times, n, time - counter->set.window[i]);
        out[i] = events->sums[n] - events->sums[first];
        counter->begun[i] = events->times[first];
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

static const double *counts_of(const Table *table, const Subject *key)
{
    int32_t at = table_find(table, key);
    return at == NONE ? NULL : payload(table, at);
}

/* Nats of a count above everybody's highest, without its rarity. */
static double counter_excess(const Counter *counter, double count, double most)
{
    double least = counter->set.least_scale;
    if (counter->set.rates)
        return log((count + least) / (most + least)) / counter->shared_scale;
    return (count - most) / fmax(least, counter->shared_scale * most);
}

static Seen counter_measure(const Counter *counter, const BehaviourLimits *limits, const Subject *whose, const double *sums, uint64_t kind)
{
    Subject by_kind = {{kind, 0, 0, 0, 0, 0}};
    const double *shared = counts_of(&counter->shared, &by_kind), *own = counts_of(&counter->highest, whose);
    Seen best = {0, 0, sums[0], counter->set.window[0], 0, counter->begun[0]};
    for (int i = 0; i < counter->usable; i++) {
        double count = sums[i], most = shared ? shared[i] : 0;
        if (count > most)
            weigh_more(counter, i, &best, counter->rarity + counter_excess(counter, count, most), count, most);
        if (own) {
            double usual = fmax(own[i], limits->neighbours_share * most);
            if (count > usual) {
                double scale = fmax(fmax(counter->set.least_scale, counter->own_scale * usual), limits->least_scale_share * most);
                weigh_more(counter, i, &best, (count - usual) / scale, count, usual);
            }
        }
    }
    return best;
}

/* The part that is new, if it is worth a message; else 0. */
static double found_added(Table *reported, const BehaviourLimits *limits, const Subject *subject, double nats, double time)
{
    if (nats < limits->least_nats)
        return 0;
    int32_t at = table_find(reported, subject);
    double faded = 0;
    if (at != NONE) {
        const Reported *former = payload(reported, at);
        faded = former->nats * pow(0.5, fmax(0.0, time - former->time) / limits->half_life_s);
    }
    nats = nats < limits->most_nats ? nats : limits->most_nats;
    double least = faded > limits->deciding_nats ? limits->least_share * faded : limits->least_step;
    if (nats < limits->least_nats || nats - faded < least)
        return 0;
    if (at == NONE) {
        if (reported->live >= limits->kept)
            table_drop(reported, reported->oldest);
        at = table_add(reported, subject);
        if (at == NONE)
            return 0;
    }
    Reported *now = payload(reported, at);
    now->nats = nats;
    now->time = time;
    return nats - faded;
}

#endif
