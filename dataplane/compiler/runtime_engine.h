/* The flow of the v1model switch around the generated parse, ingress, egress, deparse.
 *
 * Generated before this: N_* counts, phv, STD(name), HAS_*, parse, ingress, egress, deparse, digest,
 * keep_list, machine_start.  The order of queues is BMv2's, one packet at a time.
 */

#define CLONED_I 1
#define CLONED_E 2
#define RECIRCULATED 4
#define REPLICATED 5
#define RESUBMITTED 6
#define DROP_PORT 511
#define MAX_PASSES 1024
#define MAX_FRAME 65535
#define KEEP_ALL 0x40000000u

enum { FRAMES, PARSER_ERRORS, DROPPED, NO_SUCH_PORT, LOOP_DROPS, OVERSIZED };

static u8 *arena(machine *m, u64 more) {
    if (m->out_used + more > m->out_room) {
        m->out_room = (m->out_used + more) * 2;
        m->out = realloc(m->out, m->out_room);
    }
    return m->out + m->out_used;
}

static void record(machine *m, u32 kind, u32 id, u64 length) {
    u32 head[4] = {kind, id, (u32)length, 0};
    if (m->marks_used == m->marks_room) {
        m->marks_room = 2 * m->marks_room + 1024;
        m->marks = realloc(m->marks, 8 * m->marks_room);
    }
    m->marks[m->marks_used++] = m->out_used;
    memcpy(m->out + m->out_used, head, 16);
    m->out_used += 16 + ((length + 7) & ~7ull);
}

PLAIN u8 *sample_begin(machine *m, u32 most, u32 head) { return arena(m, 16 + head + most + 16) + 16 + head; }

PLAIN void sample_end(machine *m, u32 id, u8 *members, u8 *end, u32 head) {
    u8 *start = members - head;
    u64 inner = (u64)(end - members), outer = 1 + varint_size(inner) + inner;
    u32 needed = 1 + varint_size(outer) + 1 + varint_size(inner);
    if (needed < head) memmove(start + needed, members, inner);
    *start = 0x1A;
    u8 *to = varint(start + 1, outer);
    *to = 0x2A;
    varint(to + 1, inner);
    record(m, OUT_DIGEST, id, needed + inner);
}

static void ingress_pass(machine *m, phv *p, u32 port);
static void egress_pass(machine *m, phv *p, u32 port);

static int spend(machine *m) {
    if (m->budget-- > 0) return 1;
    m->stats[LOOP_DROPS]++;
    return 0;
}

static void fresh(phv *p, const u8 *frame, u32 size, u64 now, u32 arrived, u32 length) {
    memset(p, 0, sizeof *p);
    p->pkt = frame;
    p->size = size;
    p->now = now;
    p->arrived = arrived;
    p->length = length;
    p->truncate = KEEP_ALL;
}

static void keep(const phv *p, phv *copy, u32 list, u32 instance) {
    memset(&copy->m, 0, sizeof copy->m);
    keep_list(copy, p, list);
    STD(copy, instance_type) = instance;
}

/* What a pass sends round again waits in a queue, as in BMv2; no recursion, whatever the program does. */
struct job {
    job *next;
    u8 *frame; /* owned, or 0 */
    u32 port;
    int to_ingress;
    phv p;
};

static job *enqueue(machine *m, u32 port, int to_ingress) {
    job *j = malloc(sizeof *j);
    j->next = 0;
    j->frame = 0;
    j->port = port;
    j->to_ingress = to_ingress;
    *m->tail = j;
    m->tail = &j->next;
    return j;
}

static void set_for(phv *copy, const replicas *r, u32 i) {
    copy->clone = copy->digest = copy->resubmit = copy->recirculate = 0;
    copy->truncate = r->length ? r->length : KEEP_ALL;
#ifdef HAS_egress_rid
    STD(copy, egress_rid) = (u16)r->to[i].instance;
#endif
}

static __attribute__((noinline)) void replica_of(machine *m, const phv *p, const replicas *r, u32 i) {
    phv copy = *p;
    set_for(&copy, r, i);
    egress_pass(m, &copy, r->to[i].port);
}

/* the last one is the packet itself, which nobody needs any more */
static void replicate(machine *m, phv *p, const replicas *r) {
    if (!r->count) return;
    for (u32 i = 0; i + 1 < r->count; i++) replica_of(m, p, r, i);
    set_for(p, r, r->count - 1);
    egress_pass(m, p, r->to[r->count - 1].port);
}

static __attribute__((noinline)) void clone_ingress(machine *m, phv *p, u32 port, u32 length) {
    const replicas *r = m->sessions[p->clone & 0x7FFF];
    p->clone = 0;
    if (!r) return;
    phv copy;
    fresh(&copy, p->pkt, p->size, p->now, p->arrived, length);
    STD(&copy, ingress_port) = (u16)port;
    parse(m, &copy);
    keep(p, &copy, p->clone_list, CLONED_I);
    replicate(m, &copy, r);
}

static __attribute__((noinline)) void resubmit(machine *m, phv *p, u32 port, u32 length) {
    phv *again = &enqueue(m, port, 1)->p;
    fresh(again, p->pkt, p->size, p->now, p->arrived, length);
    keep(p, again, p->resubmit, RESUBMITTED);
    STD(again, packet_length) = length;
}

static void ingress_pass(machine *m, phv *p, u32 port) {
    if (!spend(m)) return;
    u32 length = p->length;
    if (parse(m, p)) m->stats[PARSER_ERRORS]++;
    ingress(m, p);
    p->exit = 0;
    if (p->clone) clone_ingress(m, p, port, length);
    if (p->digest) digest(m, p);
    if (p->resubmit) {
        resubmit(m, p, port, length);
        return;
    }
#ifdef HAS_mcast_grp
    if (STD(p, mcast_grp)) {
        const replicas *r = m->groups[STD(p, mcast_grp)];
        STD(p, instance_type) = REPLICATED;
        if (r) replicate(m, p, r);
        return;
    }
#endif
    if (STD(p, egress_spec) == DROP_PORT) return;
    STD(p, instance_type) = 0;
    egress_pass(m, p, STD(p, egress_spec));
}

static __attribute__((noinline)) const replicas *clone_egress(machine *m, phv *p, phv *copy) {
    const replicas *r = m->sessions[p->clone & 0x7FFF];
    p->clone = 0;
    if (!r) return 0;
    *copy = *p;
    copy->exit = 0;
    keep(p, copy, p->clone_list, CLONED_E);
    return r;
}

static __attribute__((noinline)) void recirculate(machine *m, phv *p, u32 size) {
    job *j = enqueue(m, 0, 1);
    j->frame = malloc(size + 1);
    memcpy(j->frame, m->out + m->out_used + 16, size);
    fresh(&j->p, j->frame, size, p->now, size, size);
    keep(p, &j->p, p->recirculate, RECIRCULATED);
    STD(&j->p, packet_length) = size;
    j->port = STD(&j->p, ingress_port);
}

static void send_out(machine *m, u32 port, u32 size) {
    if (port == m->cpu_port) {
        record(m, OUT_CPU, port, size);
        m->verdict |= 1;
    } else if (port < 512 && m->ports[port]) {
        record(m, OUT_PORT, port, size);
        m->verdict |= 2;
    } else {
        m->stats[NO_SUCH_PORT]++;
    }
}

/* the copy's buffer lives only in the frames that make one */
static __attribute__((noinline)) void leave(machine *m, phv *p, u32 port) {
    if (STD(p, egress_spec) == DROP_PORT) return;
    arena(m, 16 + DEPARSED_MOST + (u64)p->size + 8);
    u32 size = deparse(m, p, m->out + m->out_used + 16);
    if (p->recirculate) recirculate(m, p, size);
    else send_out(m, port, size);
}

static __attribute__((noinline)) void leave_with_clone(machine *m, phv *p, u32 port) {
    phv copy;
    const replicas *r = clone_egress(m, p, &copy);
    leave(m, p, port);
    for (u32 i = 0; r && i < r->count; i++) {
        job *j = enqueue(m, r->to[i].port, 0);
        j->p = copy;
        set_for(&j->p, r, i);
    }
}

static void egress_pass(machine *m, phv *p, u32 port) {
    if (!spend(m)) return;
#ifdef HAS_egress_global_timestamp
    STD(p, egress_global_timestamp) = p->now;
#endif
#ifdef HAS_enq_timestamp
    STD(p, enq_timestamp) = (u32)p->now;
#endif
    STD(p, egress_port) = (u16)port;
    STD(p, egress_spec) = 0;
    STD(p, packet_length) = p->length;
    egress(m, p);
    if (p->clone) leave_with_clone(m, p, port);
    else leave(m, p, port);
}

static __attribute__((noinline)) void run_queue(machine *m) {
    /* frames of copies are borrowed from the jobs that made them: free all at the end */
    for (job *j = m->head; j; j = j->next) {
        if (j->to_ingress) ingress_pass(m, &j->p, j->port);
        else egress_pass(m, &j->p, j->port);
    }
    for (job *j = m->head, *next; j; j = next) {
        next = j->next;
        free(j->frame);
        free(j);
    }
    m->head = 0;
    m->tail = &m->head;
}

/* -- what Python calls ---------------------------------------------------------------------------- */

void *dp_new(u32 cpu_port) {
    machine *m = calloc(1, sizeof *m);
    if (!m) return 0;
    hashes_start();
    m->cpu_port = cpu_port;
    m->tail = &m->head;
    m->seed = 0x9E3779B97F4A7C15ull;
    memset(m->ports, 1, sizeof m->ports);
    m->sessions = calloc(0x8000, sizeof *m->sessions);
    m->groups = calloc(0x10000, sizeof *m->groups);
    machine_start(m);
    return m;
}

void dp_free(void *h) {
    machine *m = h;
    for (u32 i = 0; i < N_TABLES; i++) table_free(&m->t[i]);
    for (u32 i = 0; i < N_COUNTERS; i++) free(m->c[i]);
    for (u32 i = 0; i < N_METERS; i++) free(m->mt[i]);
    for (u32 i = 0; i < N_REGISTERS; i++) cells_free(m->reg[i], m->cells[i]);
    for (u32 i = 0; i < 0x8000; i++) free(m->sessions[i]);
    for (u32 i = 0; i < 0x10000; i++) free(m->groups[i]);
    free(m->sessions);
    free(m->groups);
    free(m->out);
    free(m->marks);
    free(m);
}

u64 dp_run(void *h, u32 port, u32 count, const u8 *data, const u32 *lengths, const u64 *times, u8 *verdicts) {
    machine *m = h;
    phv p;
    m->out_used = m->marks_used = 0;
    for (u32 i = 0; i < count; i++) {
        u32 size = lengths[i];
        m->verdict = 0;
        m->budget = MAX_PASSES;
        m->stats[FRAMES]++;
        if (size > MAX_FRAME) {
            m->stats[OVERSIZED]++;
        } else {
            fresh(&p, data, size, times[i] & 0xFFFFFFFFFFFFull, size, size);
            STD(&p, ingress_port) = (u16)port;
            STD(&p, packet_length) = size;
#ifdef HAS_ingress_global_timestamp
            STD(&p, ingress_global_timestamp) = p.now;
#endif
            ingress_pass(m, &p, port);
            if (m->head) run_queue(m);
        }
        if (!m->verdict) m->stats[DROPPED]++;
        verdicts[i] = m->verdict;
        data += size;
    }
    return m->out_used;
}

const u8 *dp_output(void *h) { return ((machine *)h)->out; }
/* where each record begins */
u64 dp_marks(void *h, const u64 **to) {
    *to = ((machine *)h)->marks;
    return ((machine *)h)->marks_used;
}
INLINE u64 mixed(u64 a, u64 b) {
    u128 product = (u128)a * b;
    return (u64)product ^ (u64)(product >> 64);
}
static u64 sample_hash(u64 seed, const u8 *sample, u64 size) {
    u64 h = seed ^ size, a, b;
    for (; size >= 16; size -= 16, sample += 16) {
        memcpy(&a, sample, 8);
        memcpy(&b, sample + 8, 8);
        h = mixed(h ^ a, b ^ 0x9E3779B97F4A7C15ull) ^ (h << 1 | h >> 63);
    }
    u8 rest[16] = {0};
    memcpy(rest, sample, size);
    memcpy(&a, rest, 8);
    memcpy(&b, rest + 8, 8);
    return mixed(h ^ a, b ^ 0xA0761D6478BD642Full) ^ (h << 1 | h >> 63);
}
/* The last run's samples of one digest, end to end; of each where it ends, and a hash.  There is room for all that was
 * put out, and for as many samples as there are marks.  Returns how many there are. */
u64 dp_samples(void *h, u32 id, u64 seed, u8 *to, u64 *ends, u64 *hashes) {
    machine *m = h;
    u64 count = 0, end = 0;
    for (u64 i = 0; i < m->marks_used; i++) {
        const u8 *at = m->out + m->marks[i];
        u32 head[4];
        memcpy(head, at, 16);
        if (head[0] != OUT_DIGEST || head[1] != id) continue;
        memcpy(to + end, at + 16, head[2]);
        end += head[2];
        ends[count] = end;
        hashes[count++] = sample_hash(seed, at + 16, head[2]);
    }
    return count;
}
void dp_statistics(void *h, u64 *to) { memcpy(to, ((machine *)h)->stats, sizeof ((machine *)h)->stats); }
void dp_out_of_range(void *h, u64 *to) { memcpy(to, ((machine *)h)->out_of_range, sizeof ((machine *)h)->out_of_range); }
void dp_ports(void *h, const u8 *exists) { memcpy(((machine *)h)->ports, exists, 512); }

static void set_replicas(replicas **place, u32 count, const u32 *pairs, u32 length) {
    free(*place);
    *place = 0;
    if (count == NONE) return;
    *place = malloc(sizeof(replicas) + count * sizeof(replica) + 8);
    (*place)->count = count;
    (*place)->length = length;
    for (u32 i = 0; i < count; i++) {
        (*place)->to[i].port = pairs[2 * i];
        (*place)->to[i].instance = pairs[2 * i + 1];
    }
}
void dp_session(void *h, u32 number, u32 count, const u32 *pairs, u32 length) {
    set_replicas(&((machine *)h)->sessions[number & 0x7FFF], count, pairs, length);
}
void dp_group(void *h, u32 number, u32 count, const u32 *pairs) {
    set_replicas(&((machine *)h)->groups[number & 0xFFFF], count, pairs, 0);
}

/* ranges: five numbers each: word, shift, mask, low, high */
void dp_insert(void *h, u32 t, u32 slot, const char *value, const char *mask, u32 ranges, const u64 *range,
               u32 rank, i64 action, const char *params, u64 now) {
    range_part parts[64];
    u64 key[2 * KEY_WORDS + 2];
    table *x = &((machine *)h)->t[t];
    memcpy(key, value, x->words * 8);
    memcpy(key + x->words, mask, x->words * 8);
    for (u32 i = 0; i < ranges && i < 64; i++, range += 5)
        parts[i] = (range_part){(u32)range[0], (u32)range[1], range[2], range[3], range[4]};
    table_insert(x, slot, key, key + x->words, ranges, parts, rank, action, params, now);
}
void dp_replace(void *h, u32 t, u32 slot, i64 action, const char *params) {
    table *x = &((machine *)h)->t[t];
    x->entries[slot].action = action;
    memcpy(x->params + (u64)slot * x->stride, params, x->stride * 8);
}
void dp_remove(void *h, u32 t, u32 slot) { table_remove(&((machine *)h)->t[t], slot); }
void dp_default(void *h, u32 t, i64 action, const char *params) {
    table *x = &((machine *)h)->t[t];
    x->default_action = action;
    memcpy(x->default_params, params, x->stride * 8);
}
void dp_entry(void *h, u32 t, u32 slot, u64 *to) {
    const entry *e = &((machine *)h)->t[t].entries[slot];
    to[0] = e->packets;
    to[1] = e->bytes;
    to[2] = e->hit;
}
void dp_set_entry(void *h, u32 t, u32 slot, u32 which, u64 a, u64 b) {
    entry *e = &((machine *)h)->t[t].entries[slot];
    if (which == 0) { e->packets = a; e->bytes = b; }
    else e->hit = a;
}
void dp_entry_meter(void *h, u32 t, u32 slot, const u64 *rates) {
    meter_set(((machine *)h)->t[t].entries[slot].meter, rates);
}
u64 *dp_counter(void *h, u32 array, u32 index) { return &((machine *)h)->c[array][2 * (u64)index]; }
void dp_meter(void *h, u32 array, u32 index, const u64 *rates) {
    meter_set(&((machine *)h)->mt[array][index], rates);
}
u64 *dp_register(void *h, u32 array, u64 limb) { return &((machine *)h)->reg[array][limb]; }
