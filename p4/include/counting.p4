// Counting for queries inside the switch.  A stage counts one query's keys for a frame; two queries that
// may match the same frame need two stages.  Cells are exact, not sketches: a cell holds the window
// number (epoch), the query and its whole key beside the count, and a cell of an older window counts as
// empty, so nothing is ever reset.  Cells are banked by the window's parity: the last window stays
// readable.  A key whose cell is taken in its window goes to the host as an overflow tuple.
//
// Three kinds of counts:
//   count        only grows: its key is reported when it reaches the threshold
//   gate         only grows, and reports nothing: from the frame on with which it reaches the threshold, the
//                key's frames are copied (for queries that need payloads)
//   difference   grows with some frames and falls with others (SYNs - FINs): what it comes to is known when
//                the window is over.  Keys that reached the threshold meanwhile wait in a ring; the query's
//                frames of later windows take one of them out each, and report it if it is still over.
//
// No index leaves its array, whatever an entry says: a BMv2 built for release does not look, and dies of it.
// An entry whose cells are not all within a bank has none: all of its keys are overflow.

const bit<32> STAGE_CELLS = 65536;        // of a stage, both banks together
const bit<32> BANK_CELLS = STAGE_CELLS / 2;
const bit<32> CELLS = 16 * STAGE_CELLS;
const bit<32> DIFFERENCE_ZERO = 0x80000000; // in the cell of a difference: it may fall below zero

// epoch (window number + 1) 32 | query 8 | source 128 | destination 128 | extra 48
// | waiting: generation of the ring that the cell waits in, 0 = none 8 | count 32
@name(".ingress.cells") register<bit<384>>(CELLS) cells;
// Rings of waiting cells: twice as long as the cells that a query has in a bank, at twice their base.
@name(".ingress.waiting") register<bit<32>>(CELLS) waiting;
// A query's ring: generation 8 | epoch of its newest frame 32 | first that waits 32
// | first that waits for the end of that epoch 32 | behind the last 32
@name(".ingress.rings") register<bit<136>>(256) rings;

control CountStage(in headers_t hdr, inout metadata_t meta)(bit<32> first_cell) {
    direct_counter(CounterType.packets) stage_counter;

    // Which cell the frame counts in; placed = 0: the entry's cells are not all within a bank.
    action locate(in bit<8> query, in address_t source, in address_t destination, in bit<48> extra,
                  in bit<64> reciprocal, in bit<32> base, in bit<32> size, out bit<1> placed) {
        bit<112> product = (bit<112>)meta.timestamp * (bit<112>)reciprocal;
        meta.cell_epoch = (bit<32>)(product >> 64) + 1; // a cell of zeros belongs to no window
        placed = 0;
        if (size != 0 && size <= BANK_CELLS && base <= BANK_CELLS - size) {
            placed = 1;
            hash(meta.cell_slot, HashAlgorithm.crc32, base, { query, source, destination, extra }, size);
            meta.cell_slot = meta.cell_slot + first_cell;
            if (meta.cell_epoch[0:0] == 1) {
                meta.cell_slot = meta.cell_slot + BANK_CELLS;
            }
            cells.read(meta.cell, meta.cell_slot);
        }
    }

    // Params: query: number of the query. *_mask: which parts of the frame are its key; extra is the
    // destination port, the length and the source port. threshold: report when the count reaches it (0 = never).
    // by_bytes: count bytes. reciprocal: 2^64 / window in us. base, size: the query's cells in a bank.
    // repeated: queries to forget for this frame when its key was seen before (distinct, then reduce).
    action count(bit<8> query, query_map_t bit_of_query, address_t source_mask, address_t destination_mask,
                 bit<16> port_mask, bit<16> length_mask, bit<32> threshold, bit<1> by_bytes,
                 bit<64> reciprocal, bit<32> base, bit<32> size, query_map_t repeated,
                 bit<16> source_port_mask) {
        stage_counter.count();
        address_t source = meta.source & source_mask;
        address_t destination = meta.destination & destination_mask;
        bit<48> extra = (meta.destination_port & port_mask) ++ ((bit<16>)meta.length & length_mask)
                        ++ (meta.source_port & source_port_mask);
        bit<1> has_cell;
        locate(query, source, destination, extra, reciprocal, base, size, has_cell);
        meta.cell_count = 0;
        if (has_cell == 1 && meta.cell[383:352] == meta.cell_epoch) {
            meta.query_map = meta.query_map & ~repeated;
            if (meta.cell[351:344] == query && meta.cell[343:216] == source
                    && meta.cell[215:88] == destination && meta.cell[87:40] == extra) {
                meta.cell_count = meta.cell[31:0];
            } else {
                has_cell = 0;
            }
        }
        if (has_cell == 0) {
            meta.overflow = meta.overflow | bit_of_query;
        } else if (meta.reading == 0) {
            bit<32> step = by_bytes == 1 ? meta.length : 32w1;
            bit<32> after = meta.cell_count |+| step;
            if (meta.cell_count < threshold && after >= threshold) {
                meta.crossed = meta.crossed | bit_of_query;
            }
            cells.write(meta.cell_slot, meta.cell_epoch ++ query ++ source ++ destination ++ extra ++ 8w0 ++ after);
        }
    }

    // Params as of count, and: answers: the frame's destination is the key's source, and so on. looks: the frame
    // counts nothing. opens: the queries that get the frame where its key's count has reached the threshold.
    // uncounted: those that get it where its key has no cell; whoever gets it must count it himself.
    // The classifier knows neither: they stand in the query map of what is copied for them.
    action gate(bit<8> query, address_t source_mask, address_t destination_mask, bit<32> threshold,
                bit<64> reciprocal, bit<32> base, bit<32> size, bit<1> answers, bit<1> looks,
                query_map_t opens, query_map_t uncounted) {
        stage_counter.count();
        address_t source = (answers == 1 ? meta.destination : meta.source) & source_mask;
        address_t destination = (answers == 1 ? meta.source : meta.destination) & destination_mask;
        bit<1> has_cell;
        locate(query, source, destination, 0, reciprocal, base, size, has_cell);
        meta.cell_count = 0;
        if (has_cell == 1 && meta.cell[383:352] == meta.cell_epoch) {
            if (meta.cell[351:344] == query && meta.cell[343:216] == source && meta.cell[215:88] == destination) {
                meta.cell_count = meta.cell[31:0];
            } else {
                has_cell = 0;
            }
        }
        query_map_t wanted = uncounted;
        if (has_cell == 1) {
            if (looks == 0) {
                meta.cell_count = meta.cell_count |+| 1;
                if (meta.reading == 0) {
                    cells.write(meta.cell_slot, meta.cell_epoch ++ query ++ source ++ destination ++ 56w0 ++ meta.cell_count);
                }
            }
            wanted = meta.cell_count >= threshold ? opens : 0;
        }
        if (meta.reading == 0) {
            meta.query_map = meta.query_map | wanted;
            meta.copies = meta.copies | wanted;
        }
    }

    // Params as of count, and: count_of: the query whose cells and ring these are, the same for all frames of
    // a difference. answers: as of gate. subtracts: the frame makes
    // the count smaller. threshold: DIFFERENCE_ZERO + what is reported. generation: 1 to 255, other than that
    // of whoever had the number count_of before.
    action difference(bit<8> count_of, query_map_t bit_of_query, address_t source_mask, address_t destination_mask,
                      bit<16> port_mask, bit<16> length_mask, bit<32> threshold, bit<1> by_bytes,
                      bit<64> reciprocal, bit<32> base, bit<32> size, bit<16> source_port_mask, bit<1> answers,
                      bit<1> subtracts, bit<8> generation) {
        stage_counter.count();
        address_t source = (answers == 1 ? meta.destination : meta.source) & source_mask;
        address_t destination = (answers == 1 ? meta.source : meta.destination) & destination_mask;
        bit<16> port = (answers == 1 ? meta.source_port : meta.destination_port) & port_mask;
        bit<16> source_port = (answers == 1 ? meta.destination_port : meta.source_port) & source_port_mask;
        bit<48> extra = port ++ ((bit<16>)meta.length & length_mask) ++ source_port;
        bit<1> placed;
        locate(count_of, source, destination, extra, reciprocal, base, size, placed);
        bit<1> has_cell = placed;
        bit<8> mark = 0;
        meta.cell_count = DIFFERENCE_ZERO;
        if (has_cell == 1 && meta.cell[383:352] == meta.cell_epoch) {
            if (meta.cell[351:344] == count_of && meta.cell[343:216] == source
                    && meta.cell[215:88] == destination && meta.cell[87:40] == extra) {
                meta.cell_count = meta.cell[31:0];
                mark = meta.cell[39:32];
            } else {
                has_cell = 0;
            }
        } else if (meta.cell[351:344] == count_of && meta.cell[39:32] == generation) {
            has_cell = 0; // one of ours waits in it, though its window is over
        }
        if (has_cell == 0) {
            meta.overflow = meta.overflow | bit_of_query;
        }

        bit<136> ring;
        rings.read(ring, (bit<32>)count_of);
        if (ring[135:128] != generation) {
            ring = generation ++ 128w0;
        }
        if (meta.cell_epoch > ring[127:96]) { // what waited until now waits for the end of a window that is over
            ring[127:96] = meta.cell_epoch;
            ring[63:32] = ring[31:0];
        }
        if (has_cell == 1 && meta.reading == 0) {
            bit<32> step = by_bytes == 1 ? meta.length : 32w1;
            bit<32> after = subtracts == 1 ? meta.cell_count |-| step : meta.cell_count |+| step;
            if (after >= threshold && mark != generation) {
                bit<32> next = ring[31:0] + 1 == 2 * size ? 32w0 : ring[31:0] + 1;
                // no room to wait, or an entry of another size wrote where this one's ring has no place
                if (next == ring[95:64] || ring[31:0] >= 2 * size) {
                    meta.crossed = meta.crossed | bit_of_query;
                } else {
                    waiting.write(first_cell + 2 * base + ring[31:0], meta.cell_slot);
                    mark = generation;
                    ring[31:0] = next;
                }
            }
            cells.write(meta.cell_slot, meta.cell_epoch ++ count_of ++ source ++ destination ++ extra ++ mark ++ after);
        }
        rings.write((bit<32>)count_of, ring);
        if (placed == 1 && ring[95:64] != ring[63:32]) {
            meta.sweep.size = 2 * size;
            meta.sweep.ring = first_cell + 2 * base;
            meta.sweep.query = count_of;
            meta.sweep.threshold = threshold;
        }
    }
    @name("queries")
    @brief("Counting queries of this stage, by their bit of the query map")
    table queries {
        key = { meta.query_map: ternary @name("query_map"); }
        actions = { count; difference; gate; NoAction; }
        default_action = NoAction();
        counters = stage_counter;
        size = 32;
    }
    apply { queries.apply(); }
}

control Counting(in headers_t hdr, inout metadata_t meta) {
    @name(".ingress.count_0") CountStage(0 * STAGE_CELLS) count_0;
    @name(".ingress.count_1") CountStage(1 * STAGE_CELLS) count_1;
    @name(".ingress.count_2") CountStage(2 * STAGE_CELLS) count_2;
    @name(".ingress.count_3") CountStage(3 * STAGE_CELLS) count_3;
    @name(".ingress.count_4") CountStage(4 * STAGE_CELLS) count_4;
    @name(".ingress.count_5") CountStage(5 * STAGE_CELLS) count_5;
    @name(".ingress.count_6") CountStage(6 * STAGE_CELLS) count_6;
    @name(".ingress.count_7") CountStage(7 * STAGE_CELLS) count_7;
    @name(".ingress.count_8") CountStage(8 * STAGE_CELLS) count_8;
    @name(".ingress.count_9") CountStage(9 * STAGE_CELLS) count_9;
    @name(".ingress.count_10") CountStage(10 * STAGE_CELLS) count_10;
    @name(".ingress.count_11") CountStage(11 * STAGE_CELLS) count_11;
    @name(".ingress.count_12") CountStage(12 * STAGE_CELLS) count_12;
    @name(".ingress.count_13") CountStage(13 * STAGE_CELLS) count_13;
    @name(".ingress.count_14") CountStage(14 * STAGE_CELLS) count_14;
    @name(".ingress.count_15") CountStage(15 * STAGE_CELLS) count_15;
    apply {
        count_0.apply(hdr, meta);
        count_1.apply(hdr, meta);
        count_2.apply(hdr, meta);
        count_3.apply(hdr, meta);
        count_4.apply(hdr, meta);
        count_5.apply(hdr, meta);
        count_6.apply(hdr, meta);
        count_7.apply(hdr, meta);
        count_8.apply(hdr, meta);
        count_9.apply(hdr, meta);
        count_10.apply(hdr, meta);
        count_11.apply(hdr, meta);
        count_12.apply(hdr, meta);
        count_13.apply(hdr, meta);
        count_14.apply(hdr, meta);
        count_15.apply(hdr, meta);
    }
}

// Takes the first cell out of a ring whose window is over, and reports it if it is over the threshold.
control Sweep(inout metadata_t meta) {
    apply {
        bit<136> ring;
        rings.read(ring, (bit<32>)meta.sweep.query);
        bit<32> head = ring[95:64];
        // not in the ring: entries of one query do not agree about its size, and nothing can be taken out
        if (head < meta.sweep.size && ring[63:32] < meta.sweep.size) {
            bit<32> slot;
            waiting.read(slot, meta.sweep.ring + head);
            slot = slot & (CELLS - 1); // P4Runtime may write the register, too
            bit<384> cell;
            cells.read(cell, slot);
            cells.write(slot, cell[383:40] ++ 8w0 ++ cell[31:0]);
            head = head + 1 == meta.sweep.size ? 32w0 : head + 1;
            rings.write((bit<32>)meta.sweep.query, ring[135:96] ++ head ++ ring[63:0]);
            meta.sweep.left = head == ring[63:32] ? 1w0 : 1w1;
            if (cell[31:0] >= meta.sweep.threshold) {
                // a frame makes one digest at most: whoever wanted one of the frame gets a copy of it
                meta.copies = meta.copies | meta.digests;
                meta.digests = 0;
                digest<count_digest_t>(1, {
                    cell[351:344], cell[383:352] - 1, cell[31:0] - DIFFERENCE_ZERO, cell[343:216], cell[215:88],
                    cell[87:72], cell[71:56], cell[55:40], meta.timestamp
                });
            }
        }
    }
}
