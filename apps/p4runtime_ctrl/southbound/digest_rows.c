/* A serialized p4.v1.DigestList as rows of fixed width: one big-endian number a member, as rows.py lays them out.
 *
 *   DigestList    digest_id = 1, list_id = 2, data = 3 (repeated), timestamp = 4
 *   P4Data        bitstring = 1, struct = 5, other kinds of data
 *   P4StructLike  members = 1 (repeated P4Data)
 *
 * Every read is checked against the end of its message; unknown fields are skipped, as protobuf does.
 */

#include <stdint.h>
#include <string.h>

typedef struct {
    const uint8_t *at, *end;
} Span;

static int varint(Span *s, uint64_t *value) {
    *value = 0;
    for (int shift = 0; shift < 70 && s->at < s->end; shift += 7) {
        uint8_t byte = *s->at++;
        if (shift < 64) *value |= (uint64_t)(byte & 0x7F) << shift;
        if (byte < 0x80) return 1;
    }
    return 0;
}

static int bytes(Span *s, Span *inner) {
    uint64_t size;
    if (!varint(s, &size) || size > (uint64_t)(s->end - s->at)) return 0;
    *inner = (Span){s->at, s->at + size};
    s->at += size;
    return 1;
}

static int fixed(Span *s, long size) {
    if (s->end - s->at < size) return 0;
    s->at += size;
    return 1;
}

/* Steps over a field without looking at it; groups, which P4Runtime does not have, are refused. */
static int skip(Span *s, uint64_t tag) {
    uint64_t number;
    Span inner;
    switch (tag & 7) {
        case 0: return varint(s, &number);
        case 1: return fixed(s, 8);
        case 2: return bytes(s, &inner);
        case 5: return fixed(s, 4);
        default: return 0;
    }
}

/* A number as so many bytes, right-aligned; 0 if it does not fit. */
static int number(const uint8_t *at, long size, uint8_t *to, long width) {
    while (size && !*at) at++, size--;
    if (size > width) return 0;
    if (width > 8) {
        memset(to, 0, width - size);
        if (size) memcpy(to + width - size, at, size);
        return 1;
    }
    uint64_t value = 0;
    while (size--) value = value << 8 | *at++;
    for (long i = width; i--; value >>= 8) to[i] = (uint8_t)value;
    return 1;
}

/* A member as switches write it: a bitstring of less than 128 bytes and nothing else.  0 if it is written otherwise. */
static int usual_member(Span *all, const uint8_t **value, long *size) {
    const uint8_t *at = all->at;
    if (all->end - at < 4 || at[0] != (1 << 3 | 2) || at[2] != (1 << 3 | 2) || at[1] > 0x7F || at[3] + 2 != at[1])
        return 0;
    if (at[1] > all->end - at - 2) return 0;
    *value = at + 4;
    *size = at[3];
    all->at = at + 4 + at[3];
    return 1;
}

/* The value of one member, right-aligned; 0 if it is damaged or does not fit. */
static int member(Span s, uint8_t *to, long width) {
    Span value = {0, 0};
    uint64_t tag;
    while (s.at < s.end) {
        if (!varint(&s, &tag)) return 0;
        if (tag == (1 << 3 | 2)) {
            if (!bytes(&s, &value)) return 0;
        } else {
            if (tag >> 3 <= 12) value.at = value.end; /* another kind of data replaces it */
            if (!skip(&s, tag)) return 0;
        }
    }
    return number(value.at, value.end - value.at, to, width);
}

static int row(Span s, const int32_t *widths, long fields, uint8_t *to) {
    Span all = {0, 0}, one;
    uint64_t tag;
    long found = 0;
    while (s.at < s.end) {
        if (!varint(&s, &tag)) return 0;
        if (tag == (5 << 3 | 2)) {
            if (!bytes(&s, &all)) return 0;
        } else if (!skip(&s, tag)) {
            return 0;
        }
    }
    while (all.at < all.end) {
        const uint8_t *value;
        long size;
        if (found < fields && usual_member(&all, &value, &size)) {
            if (!number(value, size, to, widths[found])) return 0;
            to += widths[found++];
            continue;
        }
        if (!varint(&all, &tag)) return 0;
        if (tag != (1 << 3 | 2)) {
            if (!skip(&all, tag)) return 0;
            continue;
        }
        if (found == fields || !bytes(&all, &one) || !member(one, to, widths[found])) return 0;
        to += widths[found++];
    }
    return found == fields;
}

/* Samples of a list, sound or not; -1 where the list itself is damaged. */
long digest_samples(const uint8_t *data, long size) {
    Span s = {data, data + size};
    uint64_t tag;
    long count = 0;
    while (s.at < s.end) {
        if (!varint(&s, &tag) || !skip(&s, tag)) return -1;
        count += tag == (3 << 3 | 2);
    }
    return count;
}

/* Writes the rows of sound samples, at most `room`; returns how many. */
long digest_rows(const uint8_t *data, long size, const int32_t *widths, long fields, long row_bytes,
                 uint8_t *rows, long room) {
    Span s = {data, data + size}, one;
    uint64_t tag;
    long count = 0;
    while (s.at < s.end && count < room) {
        if (!varint(&s, &tag)) break;
        if (tag != (3 << 3 | 2)) {
            if (!skip(&s, tag)) break;
            continue;
        }
        if (!bytes(&s, &one)) break;
        count += row(one, widths, fields, rows + count * row_bytes);
    }
    return count;
}
