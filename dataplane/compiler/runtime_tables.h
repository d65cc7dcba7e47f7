/* Tables: entries, how they are found, and how they come and go.
 *
 * A table of a few entries is a list, best first.  A larger one is searched as a tuple space:
 * Entries with one mask form a group: a hash table of chains, each chain best first.  Groups are asked in
 * the order of their best entry, and no further than an entry that no later group can beat.
 * Nearly all frames match no entry of a big table.  A Bloom filter with one hash, 8 bits for each chain, says
 * so out of the nearest cache; without it every other frame would fetch an entry to compare with.
 */

#define NONE 0xFFFFFFFFu
#define FEW 16

typedef struct { u32 word, shift; u64 mask, low, high; } range_part;

typedef struct {
    u64 packets, bytes, hit;
    i64 order; /* smaller wins: -rank, then slot */
    i64 action;
    u32 next, group, ranges, used;
    range_part *range;
    meter *meter;
} entry;

typedef struct {
    i64 best;
    u64 *seen; /* the filter: 8 * size bits; those of removed entries stay until it is made again */
    u32 *heads, size, count, used, place, removed;
    /* the key words that this mask looks at, and the bits of them in which all entries agree */
    u32 n, at[KEY_WORDS];
    u64 mask[KEY_WORDS], agreed[KEY_WORDS], value[KEY_WORDS];
} group;

/* a group in the order of search, with its most telling word: most lookups end here */
typedef struct {
    i64 best;
    u64 agreed, value;
    u32 at, group;
} probe;

/* an entry of a short list, with the most telling word of its own */
typedef struct {
    u64 mask, value;
    u32 at, slot;
} row;

typedef struct {
    u32 words, stride, slots, groups, count, listed, metered;
    entry *entries;
    u64 *keys, *params, *default_params;
    i64 default_action;
    group *group;
    probe *list;
    u32 in_list; /* whether the list is shorter than the way through the groups */
    row rows[FEW];
} table;

INLINE u64 key_hash(const u64 *k, const group *g) {
    u64 h = 0x9E3779B97F4A7C15ull;
    for (u32 i = 0; i < g->n; i++) {
        h = (h ^ (k[g->at[i]] & g->mask[i])) * 0xD6E8FEB86659FD93ull;
        h ^= h >> 32;
    }
    return h;
}

/* the bit of a hash in the filter: not of those that choose the chain */
INLINE u64 seen_bit(u64 hash, const group *g) { return hash >> 32 & (8ull * g->size - 1); }

/* could any entry of the group have these bits? */
INLINE int group_may(const group *g, const u64 *k) {
    u64 d = 0;
    for (u32 i = 0; i < g->n; i++) d |= (k[g->at[i]] ^ g->value[i]) & g->agreed[i];
    return !d;
}

INLINE int in_ranges(const entry *e, const u64 *k) {
    for (u32 i = 0; i < e->ranges; i++) {
        const range_part *r = &e->range[i];
        u64 v = k[r->word] >> r->shift & r->mask;
        if (v < r->low || v > r->high) return 0;
    }
    return 1;
}

INLINE int entry_is(const table *t, u32 slot, const group *g, const u64 *k) {
    const u64 *v = t->keys + (u64)slot * t->words;
    u64 difference = 0;
    for (u32 w = 0; w < g->n; w++) difference |= (k[g->at[w]] & g->mask[w]) ^ v[g->at[w]];
    return !difference && in_ranges(&t->entries[slot], k);
}

INLINE entry *find_in_list(const table *t, const u64 *k) {
    for (u32 i = 0; i < t->count; i++) {
        const row *r = &t->rows[i];
        if ((k[r->at] ^ r->value) & r->mask) continue;
        entry *e = &t->entries[r->slot];
        if (entry_is(t, r->slot, &t->group[e->group], k)) return e;
    }
    return 0;
}

PLAIN entry *find_in_groups(const table *t, const u64 *k) {
    entry *found = 0;
    for (u32 i = 0; i < t->listed; i++) {
        const probe *p = &t->list[i];
        if ((k[p->at] ^ p->value) & p->agreed) continue;
        if (found && p->best > found->order) break;
        const group *g = &t->group[p->group];
        if (!group_may(g, k)) continue;
        u64 hash = key_hash(k, g), bit = seen_bit(hash, g);
        if (!(g->seen[bit / 64] >> bit % 64 & 1)) continue;
        u32 at = g->heads[hash & (g->size - 1)];
        for (; at != NONE; at = t->entries[at].next) {
            entry *e = &t->entries[at];
            if (found && e->order > found->order) break;
            if (entry_is(t, at, g, k)) {
                found = e;
                break;
            }
        }
    }
    return found;
}

PLAIN entry *table_find(const table *t, const u64 *k) {
    return t->in_list ? find_in_list(t, k) : find_in_groups(t, k);
}

static void table_grow(table *t, u32 slot) {
    u32 slots = t->slots ? t->slots : 16;
    while (slots <= slot) slots *= 2;
    if (slots == t->slots) return;
    t->entries = realloc(t->entries, slots * sizeof(entry));
    memset(t->entries + t->slots, 0, (slots - t->slots) * sizeof(entry));
    t->keys = realloc(t->keys, (u64)slots * t->words * 8 + 8);
    t->params = realloc(t->params, (u64)slots * t->stride * 8 + 8);
    t->slots = slots;
}

static void group_link(table *t, group *g, u32 slot) {
    entry *e = &t->entries[slot];
    u64 hash = key_hash(t->keys + (u64)slot * t->words, g), bit = seen_bit(hash, g);
    g->seen[bit / 64] |= 1ull << bit % 64;
    u32 *at = &g->heads[hash & (g->size - 1)];
    while (*at != NONE && t->entries[*at].order < e->order) at = &t->entries[*at].next;
    e->next = *at;
    *at = slot;
}

static void group_resize(table *t, u32 number, u32 size) {
    group *g = &t->group[number];
    g->heads = realloc(g->heads, size * sizeof(u32));
    g->seen = realloc(g->seen, size);
    memset(g->seen, 0, size);
    g->size = size;
    g->removed = 0;
    for (u32 i = 0; i < size; i++) g->heads[i] = NONE;
    for (u32 slot = 0; slot < t->slots; slot++)
        if (t->entries[slot].used && t->entries[slot].group == number) group_link(t, g, slot);
}

/* Zeros tell little: most words of most frames are zero there, as IPv4 in 128 bits. */
INLINE int telling(u64 mask, u64 value) {
    return 64 * __builtin_popcountll(mask & value) + __builtin_popcountll(mask);
}

static void probe_set(table *t, u32 number) {
    group *g = &t->group[number];
    probe *p = &t->list[g->place];
    *p = (probe){g->best, 0, 0, 0, number};
    int most = -1;
    for (u32 i = 0; i < g->n; i++) {
        int bits = telling(g->agreed[i], g->value[i]);
        if (bits <= most) continue;
        most = bits;
        p->agreed = g->agreed[i];
        p->value = g->value[i];
        p->at = g->at[i];
    }
}

static row row_of(const table *t, u32 slot) {
    const group *g = &t->group[t->entries[slot].group];
    const u64 *v = t->keys + (u64)slot * t->words;
    row r = {0, 0, 0, slot};
    int most = -1;
    for (u32 i = 0; i < g->n; i++) {
        int bits = telling(g->mask[i], v[g->at[i]]);
        if (bits <= most) continue;
        most = bits;
        r = (row){g->mask[i], v[g->at[i]], g->at[i], slot};
    }
    return r;
}

/* after an entry came or went */
static void rows_set(table *t) {
    u32 n = 0, steps = 0;
    t->in_list = 0;
    if (t->count > FEW) return;
    for (u32 i = 0; i < t->groups; i++)
        if (t->group[i].used) steps += t->group[i].n ? 4 : t->group[i].count;
    if (t->count > steps) return;
    t->in_list = 1;
    for (u32 slot = 0; n < t->count; slot++) {
        if (!t->entries[slot].used) continue;
        u32 j = n++;
        while (j && t->entries[t->rows[j - 1].slot].order > t->entries[slot].order) { t->rows[j] = t->rows[j - 1]; j--; }
        t->rows[j] = row_of(t, slot);
    }
}

static void table_list(table *t) {
    u32 n = 0;
    t->list = realloc(t->list, (t->groups + 1) * sizeof(probe));
    for (u32 i = 0; i < t->groups; i++) {
        if (!t->group[i].used) continue;
        u32 j = n++;
        while (j && t->list[j - 1].best > t->group[i].best) { t->list[j] = t->list[j - 1]; j--; }
        t->list[j].best = t->group[i].best;
        t->list[j].group = i;
    }
    t->listed = n;
    for (u32 i = 0; i < n; i++) {
        t->group[t->list[i].group].place = i;
        probe_set(t, t->list[i].group);
    }
}

static int same_mask(const group *g, const u64 *mask, u32 words) {
    u32 j = 0;
    for (u32 i = 0; i < words; i++) {
        u64 own = j < g->n && g->at[j] == i ? g->mask[j++] : 0;
        if (own != mask[i]) return 0;
    }
    return 1;
}

static u32 table_group(table *t, const u64 *mask, const u64 *value) {
    u32 free = t->groups;
    for (u32 i = 0; i < t->groups; i++) {
        if (!t->group[i].used) free = i;
        else if (same_mask(&t->group[i], mask, t->words)) return i;
    }
    if (free == t->groups) {
        t->group = realloc(t->group, (t->groups + 1) * sizeof(group));
        memset(&t->group[t->groups++], 0, sizeof(group));
    }
    group *g = &t->group[free];
    g->used = 1;
    g->count = 0;
    g->best = INT64_MAX;
    g->n = 0;
    for (u32 i = 0; i < t->words; i++) {
        if (!mask[i]) continue;
        g->at[g->n] = i;
        g->mask[g->n] = g->agreed[g->n] = mask[i];
        g->value[g->n++] = value[i] & mask[i];
    }
    group_resize(t, free, 16);
    return free;
}

PLAIN void table_insert(table *t, u32 slot, const u64 *value, const u64 *mask, u32 ranges,
                        const range_part *range, u32 rank, i64 action, const char *params, u64 now) {
    table_grow(t, slot);
    entry *e = &t->entries[slot];
    meter *kept = e->meter;
    memset(e, 0, sizeof *e);
    e->meter = kept;
    if (t->metered) {
        if (!e->meter) e->meter = malloc(sizeof(meter));
        meter_set(e->meter, 0);
    }
    e->order = -((i64)rank << 32) + slot;
    e->action = action;
    e->hit = now;
    e->ranges = ranges;
    if (ranges) {
        e->range = malloc(ranges * sizeof(range_part));
        memcpy(e->range, range, ranges * sizeof(range_part));
    }
    for (u32 i = 0; i < t->words; i++) t->keys[(u64)slot * t->words + i] = value[i] & mask[i];
    memcpy(t->params + (u64)slot * t->stride, params, t->stride * 8);
    e->group = table_group(t, mask, value);
    e->used = 1;
    group *g = &t->group[e->group];
    for (u32 i = 0; i < g->n; i++) g->agreed[i] &= ~(value[g->at[i]] ^ g->value[i]);
    g->count++;
    if (g->count > g->size) group_resize(t, e->group, g->size * 4);
    else group_link(t, g, slot);
    if (e->order < g->best) {
        g->best = e->order;
        table_list(t);
    } else {
        probe_set(t, e->group);
    }
    t->count++;
    rows_set(t);
}

PLAIN void table_remove(table *t, u32 slot) {
    entry *e = &t->entries[slot];
    group *g = &t->group[e->group];
    u32 *at = &g->heads[key_hash(t->keys + (u64)slot * t->words, g) & (g->size - 1)];
    while (*at != slot) at = &t->entries[*at].next;
    *at = e->next;
    e->used = 0;
    free(e->range);
    e->range = 0;
    g->count--;
    t->count--;
    if (!g->count) g->used = 0;
    else if (++g->removed > g->size) group_resize(t, e->group, g->size);
    rows_set(t);
    /* a bound that is too good is still right: it only makes a search look here in vain */
    if (g->count && (e->order != g->best || g->size > 64)) return;
    g->best = INT64_MAX;
    for (u32 i = 0; g->count && i < g->size; i++)
        if (g->heads[i] != NONE && t->entries[g->heads[i]].order < g->best) g->best = t->entries[g->heads[i]].order;
    table_list(t);
}

PLAIN void table_free(table *t) {
    for (u32 i = 0; i < t->slots; i++) {
        if (t->entries[i].used) free(t->entries[i].range);
        free(t->entries[i].meter);
    }
    for (u32 i = 0; i < t->groups; i++) {
        free(t->group[i].heads);
        free(t->group[i].seen);
    }
    free(t->entries);
    free(t->keys);
    free(t->params);
    free(t->default_params);
    free(t->group);
    free(t->list);
}
