/* From scores to anomalous seconds of senders: `senders.py`, `conversations.py` and what `roles.py` learns, in C.
 *
 *     rows ──► sender ──► who is charged ──► tally of the open second ──► SenderEvent when it closes
 */

#include "packet_rows.h"

#define HISTORY_S 10
#define BACKWARDS_S 10
#define UDP_REPLY_S 5.0
#define TCP_REPLY_S 65.0

/* A sender first seen, a destination behind a MAC, the end of training, a clock set back, an anomalous second, a
 * sender with such seconds forgotten. */
enum { SEEN, TOWARDS, TRAINED, CLOCK_SET_BACK, ANOMALOUS, FORGOTTEN };

typedef struct {
    int32_t what, kept_in, kept_at, row;
    uint64_t who[4];
    int64_t second, packets, over, destinations;
    uint64_t first_over;
    int64_t training_rate, training_destinations;
    double peak;
} SenderEvent;

typedef struct {
    int64_t training_rate, training_destinations, last_second;
    int64_t serial; /* of the second that `tally` belongs to */
    int32_t tally, was_anomalous;
} Record;

typedef struct {
    int32_t sender, kept_in, kept_at;
    int64_t packets, over, destinations, peak_row;
    uint64_t first_over;
    double peak;
    Address last_destination;
    int32_t has_destination;
} Tally;

typedef struct {
    double time;
    int32_t sender, credit;
} Conversation;

typedef struct {
    int64_t packets, multicast;
    int32_t dns, dhcp;
} Speaker;

/* Of one packet: who sends it, its conversation there and back; the latter two of packets with ports. */
typedef struct {
    Key identity, there, back;
} Keys;

typedef struct {
    int64_t most_senders;
    int32_t most_conversations, anomalous_packets, replies_per_packet;
    double anomalous_share;
} SenderLimits;

typedef struct {
    SenderLimits limits;
    Table records, destinations, young, old, towards, speakers, blocked;
    Tally *tallies;
    int32_t tally_count, tally_room;
    int64_t serial, second;
    double turned;
    int has_second, training, failed;
    int32_t batch;
    SenderEvent *events;
    long event_count, event_room;
} Senders;

static SenderEvent *new_event(Senders *s, int what)
{
    if (s->event_count == s->event_room) {
        long room = s->event_room ? s->event_room * 2 : 256;
        SenderEvent *events = realloc(s->events, (size_t)room * sizeof *events);
        if (!events) {
            s->failed = 1;
            return NULL;
        }
        s->events = events;
        s->event_room = room;
    }
    SenderEvent *event = &s->events[s->event_count++];
    memset(event, 0, sizeof *event);
    event->what = what;
    return event;
}

static void name_event(Senders *s, int what, const Subject *key)
{
    SenderEvent *event = new_event(s, what);
    if (event)
        memcpy(event->who, key->word, sizeof event->who);
}

static int32_t added(Senders *s, Table *table, const Key *key)
{
    int32_t at = add_key(table, key);
    if (at == NONE)
        s->failed = 1;
    return at;
}

/* Whether the subject is new; then it is added. */
static int is_new(Senders *s, Table *table, Subject subject)
{
    Key key = keyed(table, subject);
    return find_key(table, &key) == NONE && added(s, table, &key) != NONE;
}

/* As `sender_of` of the rows, with the version itself: what has no address is another than 0.0.0.0. */
static Subject identity_of(uint16_t number, const Row *row)
{
    Subject key = {{row->mac | (uint64_t)row->port << 48, number | (uint64_t)row->source.version << 16, row->source.hi, row->source.lo, 0, 0}};
    return key;
}

static Record *record_of(Senders *s, int32_t number)
{
    return head(&s->records, number)->older == VACANT ? NULL : payload(&s->records, number);
}

static Address record_address(const Subject *key)
{
    Address found = {key->word[2], key->word[3], (uint8_t)(key->word[1] >> 16)};
    return found;
}

static int32_t number_of(Senders *s, const Key *identity)
{
    int32_t number = find_key(&s->records, identity);
    if (number != NONE)
        return number;
    number = added(s, &s->records, identity);
    if (number == NONE)
        return NONE;
    Record *record = payload(&s->records, number);
    record->last_second = s->has_second ? s->second : 0;
    record->serial = -1;
    name_event(s, SEEN, &identity->subject);
    return number;
}

/* ---- seconds */

static void note_rates(Senders *s)
{
    for (int32_t i = 0; i < s->tally_count; i++) {
        const Tally *tally = &s->tallies[i];
        Record *record = record_of(s, tally->sender);
        if (!record)
            continue;
        if (tally->packets > record->training_rate)
            record->training_rate = tally->packets;
        if (tally->destinations > record->training_destinations)
            record->training_destinations = tally->destinations;
    }
}

static void forget(Senders *s, int64_t second)
{
    for (int32_t number = 0; number < s->records.used; number++) {
        Record *record = record_of(s, number);
        if (record && !record->training_rate && record->last_second < second - HISTORY_S) {
            if (record->was_anomalous)
                name_event(s, FORGOTTEN, &head(&s->records, number)->key);
            table_drop(&s->records, number);
        }
    }
}

static void tell_anomalous(Senders *s, const Tally *tally, Record *record, int64_t second)
{
    SenderEvent *event = new_event(s, ANOMALOUS);
    if (!event)
        return;
    memcpy(event->who, head(&s->records, tally->sender)->key.word, sizeof event->who);
    event->second = second;
    event->packets = tally->packets;
    event->over = tally->over;
    event->destinations = tally->destinations;
    event->first_over = tally->first_over;
    event->peak = tally->peak;
    event->training_rate = record->training_rate;
    event->training_destinations = record->training_destinations;
    event->row = (int32_t)tally->peak_row;
    event->kept_in = tally->kept_in;
    event->kept_at = tally->kept_at;
    record->was_anomalous = 1;
}

static void close_second(Senders *s)
{
    if (s->training)
        note_rates(s);
    int64_t second = s->has_second ? s->second : 0;
    for (int32_t i = 0; i < s->tally_count; i++) {
        const Tally *tally = &s->tallies[i];
        Record *record = record_of(s, tally->sender);
        if (!record)
            continue;
        record->last_second = second;
        if (tally->over >= s->limits.anomalous_packets && (double)tally->over >= s->limits.anomalous_share * (double)tally->packets)
            tell_anomalous(s, tally, record, second);
    }
    s->tally_count = 0;
    s->serial++;
    table_clear(&s->destinations);
    if (s->records.live > s->limits.most_senders)
        forget(s, second);
}

static void turn(Senders *s, int64_t second)
{
    if (s->has_second && second < s->second) {
        if (s->second - second <= BACKWARDS_S)
            return; /* a late packet counts towards the open second */
        new_event(s, CLOCK_SET_BACK);
    }
    close_second(s);
    s->second = second;
    s->has_second = 1;
}

static Tally *tally_of(Senders *s, int32_t number)
{
    Record *record = payload(&s->records, number);
    if (record->serial == s->serial)
        return &s->tallies[record->tally];
    if (s->tally_count == s->tally_room) {
        int32_t room = s->tally_room ? s->tally_room * 2 : 256;
        Tally *tallies = realloc(s->tallies, (size_t)room * sizeof *tallies);
        if (!tallies) {
            s->failed = 1;
            return NULL;
        }
        s->tallies = tallies;
        s->tally_room = room;
    }
    record->serial = s->serial;
    record->tally = s->tally_count;
    Tally *tally = &s->tallies[s->tally_count++];
    memset(tally, 0, sizeof *tally);
    tally->sender = number;
    tally->peak = -INFINITY;
    tally->peak_row = tally->kept_in = NONE;
    return tally;
}

static void count_destination(Senders *s, Tally *tally, Address to)
{
    if (tally->has_destination && same_address(tally->last_destination, to) && tally->last_destination.version == to.version)
        return;
    tally->has_destination = 1;
    tally->last_destination = to;
    Subject key = pair_of((uint32_t)tally->sender, to.version, to, (Address){0, 0, 0});
    if (is_new(s, &s->destinations, key))
        tally->destinations++;
}

static void mark(Tally *tally, double score, uint64_t arrival, long row)
{
    if (!tally->over)
        tally->first_over = arrival;
    tally->over++;
    if (!(score <= tally->peak)) {
        tally->peak = score;
        tally->peak_row = row;
    }
}

/* ---- who is charged */

static Subject conversation_of(const Row *row, int back)
{
    Address address = back ? row->target : row->source;
    uint64_t sport = (uint32_t)(back ? row->dport : row->sport), dport = (uint32_t)(back ? row->sport : row->dport);
    return pair_of((uint64_t)row->is_tcp | (uint64_t)address.version << 8, sport | dport << 32, address, (Address){0, 0, 0});
}

static Conversation *begun(Senders *s, const Key *key, double time)
{
    int32_t at = find_key(&s->young, key);
    Table *table = at != NONE ? &s->young : &s->old;
    if (at == NONE)
        at = find_key(&s->old, key);
    if (at == NONE)
        return NULL;
    Conversation *found = payload(table, at);
    double within = key->subject.word[0] & 1 ? TCP_REPLY_S : UDP_REPLY_S;
    return fabs(time - found->time) <= within ? found : NULL;
}

static void begin(Senders *s, const Key *key, int32_t sender, double time)
{
    double passed = time - s->turned;
    if (!(passed >= 0 && passed <= TCP_REPLY_S) || s->young.live >= s->limits.most_conversations) {
        Table older = s->old;
        s->old = s->young;
        s->young = older;
        table_clear(&s->young);
        s->turned = time;
    }
    int32_t at = find_key(&s->young, key), each = s->limits.replies_per_packet;
    if (at == NONE)
        at = added(s, &s->young, key);
    if (at == NONE)
        return;
    Conversation *found = payload(&s->young, at);
    if (found->sender != sender)
        found->credit = 0;
    found->sender = sender;
    found->time = time;
    found->credit = found->credit + each < 10 * each ? found->credit + each : 10 * each;
}

static int32_t charge(Conversation *conversation, int32_t sender)
{
    if (conversation->credit <= 0)
        return sender;
    conversation->credit--;
    return conversation->sender;
}

static int32_t responsible(Senders *s, const Row *row, const Keys *keys, int32_t sender)
{
    if (row->sport < 0)
        return sender;
    if (row->quoted) {
        /* the ports are those of the packet that the error quotes */
        Key sent = keyed(&s->young, pair_of((uint64_t)row->is_tcp | (uint64_t)row->target.version << 8, join_ports((uint32_t)row->sport, (uint32_t)row->dport), row->target, (Address){0, 0, 0}));
        Conversation *quoted = begun(s, &sent, row->time);
        return quoted ? charge(quoted, sender) : sender;
    }
    int is_reply = !row->is_tcp || is_tcp_reply(row->flags), is_syn = row->is_tcp && (row->flags & (SYN | ACK)) == SYN;
    Conversation *found = is_syn ? NULL : begun(s, &keys->back, row->time);
    if (found)
        return is_reply ? charge(found, sender) : sender;
    if (!(row->is_tcp && is_reply))
        begin(s, &keys->there, sender, row->time);
    return sender;
}

/* Whether a packet answers a sender that is blocked, seen to begin the conversation or not. */
static int concerns_blocked(Senders *s, const Row *row, uint16_t number, int32_t sender, int32_t charged)
{
    if (charged == sender)
        return (row->quoted || row->udp_sport >= 0 || is_tcp_reply(row->flags)) && is_blocked(&s->blocked, number, row->to_mac, row->target);
    const Subject *key = &head(&s->records, charged)->key;
    return is_blocked(&s->blocked, (uint16_t)key->word[1], key->word[0] & 0xFFFFFFFFFFFFu, record_address(key));
}

/* ---- roles */

static void learn_roles(Senders *s, const Row *row)
{
    if (row->target.version && !row->to_group) {
        Subject key = {{row->to_mac, (uint64_t)row->target.version << 16, row->target.hi, row->target.lo, 0, 0}};
        if (s->towards.live >= 1 << 20)
            table_clear(&s->towards); /* Python keeps a set: telling twice does no harm */
        if (is_new(s, &s->towards, key))
            name_event(s, TOWARDS, &key);
    }
    Key key = keyed(&s->speakers, pair_of(row->source.version, 0, row->source, (Address){0, 0, 0}));
    int32_t at = find_key(&s->speakers, &key);
    if (at == NONE)
        at = added(s, &s->speakers, &key);
    if (at == NONE)
        return;
    Speaker *speaker = payload(&s->speakers, at);
    speaker->packets++;
    speaker->multicast += row->to_group;
    speaker->dns |= row->udp_sport == 53;
    speaker->dhcp |= row->udp_sport == 67;
}

static void end_training(Senders *s)
{
    s->training = 0;
    note_rates(s);
    new_event(s, TRAINED);
}

/* ---- the interface */

static void take_row(Senders *s, const Row *row, const Keys *keys, uint16_t number, int trains, double score, double threshold, long at)
{
    if (!s->has_second || row->second != s->second)
        turn(s, row->second);
    int32_t sender = number_of(s, &keys->identity);
    if (sender == NONE)
        return;
    int32_t charged = responsible(s, row, keys, sender);
    if (!record_of(s, charged))
        charged = sender; /* who began the conversation is forgotten */
    if (s->blocked.live && concerns_blocked(s, row, number, sender, charged))
        return;
    Tally *tally = tally_of(s, charged);
    if (!tally)
        return;
    tally->packets++;
    if (charged == sender)
        count_destination(s, tally, row->target);
    if (trains) {
        learn_roles(s, row);
        return;
    }
    if (s->training)
        end_training(s);
    if (!(score < threshold))
        mark(tally, score, row->arrival, at);
}

/* ---- rows ahead: what they will look up is fetched early; all tables hash with one seed */

#define AHEAD 8

static inline void look_ahead(const Senders *s, const Row *row, uint16_t number, Keys *keys)
{
    keys->identity = keyed(&s->records, identity_of(number, row));
    fetch_slot(&s->records, keys->identity.hash);
    if (row->sport < 0)
        return;
    keys->there = keyed(&s->young, conversation_of(row, 0));
    keys->back = keyed(&s->young, conversation_of(row, 1));
    fetch_slot(&s->young, keys->there.hash);
    fetch_slot(&s->young, keys->back.hash);
    fetch_slot(&s->old, keys->back.hash);
}

static inline void fetch_entries(const Senders *s, const Row *row, const Keys *keys)
{
    fetch_entry(&s->records, &keys->identity);
    if (row->sport < 0)
        return;
    fetch_entry(&s->young, &keys->there);
    fetch_entry(&s->young, &keys->back);
    fetch_entry(&s->old, &keys->back);
}

/* n rows, of which the first `trained` were training.  The rows of peaks that are to be kept go to `peaks` (room for
 * n), their number to kept[0]; the number of this batch and of the oldest in which a peak is kept to kept[1] and [2].
 * -1 when memory is short. */
int senders_add(Senders *s, const Row *rows, long n, long trained, uint16_t number, const double *scores, double threshold, int32_t *peaks, long *kept)
{
    s->event_count = 0;
    s->batch++;
    Keys ahead[AHEAD];
    for (long i = 0; i < n && i < AHEAD; i++)
        look_ahead(s, &rows[i], number, &ahead[i]);
    for (long i = 0; i < n && !s->failed; i++) {
        if (i + AHEAD / 2 < n)
            fetch_entries(s, &rows[i + AHEAD / 2], &ahead[(i + AHEAD / 2) % AHEAD]);
        take_row(s, &rows[i], &ahead[i % AHEAD], number, i < trained, scores[i], threshold, i);
        if (i + AHEAD < n)
            look_ahead(s, &rows[i + AHEAD], number, &ahead[i % AHEAD]);
    }
    kept[0] = 0;
    kept[1] = kept[2] = s->batch;
    for (int32_t i = 0; i < s->tally_count; i++) {
        Tally *tally = &s->tallies[i];
        if (tally->peak_row >= 0) {
            peaks[kept[0]] = (int32_t)tally->peak_row;
            tally->kept_in = s->batch;
            tally->kept_at = (int32_t)kept[0]++;
            tally->peak_row = NONE;
        }
        if (tally->kept_in >= 0 && tally->kept_in < kept[2])
            kept[2] = tally->kept_in;
    }
    return s->failed ? -1 : 0;
}

/* The capture has ended: closes the second that is still open. */
int senders_finish(Senders *s)
{
    s->event_count = 0;
    close_second(s);
    s->has_second = 0;
    return s->failed ? -1 : 0;
}

const SenderEvent *senders_events(const Senders *s, long *count)
{
    *count = s->event_count;
    return s->events;
}

void senders_free(Senders *s)
{
    if (!s)
        return;
    Table *tables[] = {&s->records, &s->destinations, &s->young, &s->old, &s->towards, &s->speakers, &s->blocked};
    for (size_t i = 0; i < sizeof tables / sizeof *tables; i++)
        table_end(tables[i]);
    free(s->tallies);
    free(s->events);
    free(s);
}

Senders *senders_new(const SenderLimits *limits, int32_t training, uint64_t seed)
{
    Senders *s = calloc(1, sizeof *s);
    if (!s)
        return NULL;
    s->limits = *limits;
    s->training = training;
    if (table_start(&s->records, sizeof(Record), seed) | table_start(&s->destinations, 0, seed) | table_start(&s->young, sizeof(Conversation), seed)
        | table_start(&s->old, sizeof(Conversation), seed) | table_start(&s->towards, 0, seed) | table_start(&s->speakers, sizeof(Speaker), seed)
        | table_start(&s->blocked, 0, seed)) {
        senders_free(s);
        return NULL;
    }
    return s;
}

int senders_know(Senders *s, const uint64_t *who, int64_t rate, int64_t destinations)
{
    Key key = keyed(&s->records, (Subject){{who[0], who[1], who[2], who[3], 0, 0}});
    s->event_count = 0;
    int32_t number = number_of(s, &key);
    if (number == NONE)
        return -1;
    Record *record = payload(&s->records, number);
    record->training_rate = rate;
    record->training_destinations = destinations;
    record->last_second = 0;
    return 0;
}

/* Senders that are remembered: four words, rate and destinations of training, last second; returns how many. */
long senders_known(const Senders *s, uint64_t *who, int64_t *numbers, long room)
{
    long count = 0;
    for (int32_t at = 0; at < s->records.used; at++) {
        const Head *each = head(&s->records, at);
        if (each->older == VACANT)
            continue;
        if (count < room) {
            const Record *record = payload(&s->records, at);
            memcpy(who + 4 * count, each->key.word, 4 * sizeof *who);
            numbers[3 * count] = record->training_rate;
            numbers[3 * count + 1] = record->training_destinations;
            numbers[3 * count + 2] = record->last_second;
        }
        count++;
    }
    return count;
}

/* Packets of a sender in the open second, and the highest rate of training. */
void senders_rates(const Senders *s, const uint64_t *who, int64_t *out)
{
    Subject key = {{who[0], who[1], who[2], who[3], 0, 0}};
    int32_t at = table_find(&s->records, &key);
    out[0] = out[1] = 0;
    if (at == NONE)
        return;
    const Record *record = payload(&s->records, at);
    out[0] = record->serial == s->serial ? s->tallies[record->tally].packets : 0;
    out[1] = record->training_rate;
}

/* Who spoke in training: version and address, packets, those to groups, whether as DNS and DHCP servers. */
long senders_speakers(const Senders *s, uint64_t *who, int64_t *numbers, long room)
{
    long count = 0;
    for (int32_t at = s->speakers.oldest; at != NONE; at = head(&s->speakers, at)->newer, count++) {
        if (count >= room)
            continue;
        const Subject *key = &head(&s->speakers, at)->key;
        const Speaker *speaker = payload(&s->speakers, at);
        uint64_t address[3] = {key->word[0], key->word[2], key->word[3]};
        int64_t found[4] = {speaker->packets, speaker->multicast, speaker->dns, speaker->dhcp};
        memcpy(who + 3 * count, address, sizeof address);
        memcpy(numbers + 4 * count, found, sizeof found);
    }
    return count;
}

int senders_blocks(Senders *s, const uint64_t *rows, long n)
{
    return take_blocks(&s->blocked, rows, n);
}

#include "senders_dump.h"
