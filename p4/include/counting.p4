// Counting for queries inside the switch.  A stage counts one query's keys for a frame; two queries that
// may match the same frame need two stages.  Cells are exact, not sketches: a cell holds the window
// number (epoch), the query and its whole key beside the count, and a cell of an older window counts as
// empty, so nothing is ever reset.  Cells are banked by the window's parity: the last window stays
// readable.  A key whose cell is taken in its window goes to the host as an overflow tuple.

const bit<32> CELLS = 65536;              // of a stage, both banks together

control CountStage(in headers_t hdr, inout metadata_t meta) {
    // epoch (window number + 1) 32 | query 8 | source 128 | destination 128 | extra 48 | count 32
    @name("cells") register<bit<376>>(CELLS) cells;
    direct_counter(CounterType.packets) stage_counter;

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
        bit<112> product = (bit<112>)meta.timestamp * (bit<112>)reciprocal;
        bit<32> epoch = (bit<32>)(product >> 64) + 1; // a cell of zeros belongs to no window
        bit<32> slot;
        hash(slot, HashAlgorithm.crc32, base, { query, source, destination, extra }, size);
        slot = slot + (epoch[0:0] == 1 ? CELLS / 2 : 32w0);
        bit<376> cell;
        cells.read(cell, slot);
        bool is_empty = cell[375:344] != epoch;
        bool is_mine = !is_empty && cell[343:336] == query && cell[335:208] == source
                       && cell[207:80] == destination && cell[79:32] == extra;
        bit<32> before = is_mine ? cell[31:0] : 32w0;
        bit<32> step = by_bytes == 1 ? meta.length : 32w1;
        bit<32> after = before |+| step;
        bool writes = (is_empty || is_mine) && meta.reading == 0;
        cells.write(slot, writes ? epoch ++ query ++ source ++ destination ++ extra ++ after : cell);
        meta.cell_epoch = epoch - 1;
        meta.cell_count = before;
        meta.crossed = meta.crossed | ((is_empty || is_mine) && threshold != 0 && before < threshold && after >= threshold ? bit_of_query : 256w0);
        meta.overflow = meta.overflow | (is_empty || is_mine ? 256w0 : bit_of_query);
        meta.query_map = meta.query_map & ~(is_empty ? 256w0 : repeated);
    }
    @name("queries")
    @brief("Counting queries of this stage, by their bit of the query map")
    table queries {
        key = { meta.query_map: ternary @name("query_map"); }
        actions = { count; NoAction; }
        default_action = NoAction();
        counters = stage_counter;
        size = 32;
    }
    apply { queries.apply(); }
}

control Counting(in headers_t hdr, inout metadata_t meta) {
    @name(".ingress.count_0") CountStage() count_0;
    @name(".ingress.count_1") CountStage() count_1;
    @name(".ingress.count_2") CountStage() count_2;
    @name(".ingress.count_3") CountStage() count_3;
    @name(".ingress.count_4") CountStage() count_4;
    @name(".ingress.count_5") CountStage() count_5;
    @name(".ingress.count_6") CountStage() count_6;
    @name(".ingress.count_7") CountStage() count_7;
    apply {
        count_0.apply(hdr, meta);
        count_1.apply(hdr, meta);
        count_2.apply(hdr, meta);
        count_3.apply(hdr, meta);
        count_4.apply(hdr, meta);
        count_5.apply(hdr, meta);
        count_6.apply(hdr, meta);
        count_7.apply(hdr, meta);
    }
}
