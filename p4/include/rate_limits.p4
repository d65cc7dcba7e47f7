// Rate limits: what comes to a victim of one kind, as answers of name servers that it never asked, may come at a
// rate and no faster.  They help where a block does not: sources are forged, too many, or innocent reflectors.
//
//   frame ─► limit: its meter green or yellow ────────────────────────────────────────────────► pass
//              │ red
//            limit_spared: a source that training knows, within a meter of its own ───────────► pass
//              │ no
//            limit_over: counted, dropped
//
// Sources that are known can be forged, too: what one gets beyond the limit is bounded by its own meter.

control RateLimits(inout metadata_t meta) {
    @name(".ingress.limit_meter") direct_meter<bit<2>>(MeterType.packets) limit_meter;
    @name(".ingress.limit_counter") direct_counter(CounterType.packets_and_bytes) limit_counter;
    @name(".ingress.limit_spared_meter") direct_meter<bit<2>>(MeterType.packets) spared_meter;
    @name(".ingress.limit_spared_counter") direct_counter(CounterType.packets_and_bytes) spared_counter;
    @name(".ingress.limit_over_counter") direct_counter(CounterType.packets_and_bytes) over_counter;

    bit<2> color = METER_GREEN;
    bit<8> limit_slot = 0;

    @name(".ingress.limit_rate") action limit_rate(bit<8> slot) {
        limit_meter.read(color);
        limit_counter.count();
        limit_slot = slot;
    }
    @name(".ingress.no_limit") action no_limit() { limit_counter.count(); }
    @name(".ingress.spare_source") action spare_source() {
        spared_meter.read(color);
        spared_counter.count();
    }
    @name(".ingress.spare_nobody") action spare_nobody() { spared_counter.count(); }
    @name(".ingress.drop_over") action drop_over() {
        meta.blocked = 1;
        over_counter.count();
    }
    @name(".ingress.pass_over") action pass_over() { over_counter.count(); }

    @name(".ingress.limit")
    @brief("Kinds of packets towards a victim, each with a meter; few, since BMv2 looks ternary entries up one by one")
    table limit {
        key = {
            meta.is_ipv4: ternary @name("is_ipv4");
            meta.destination: ternary @name("dst");
            meta.protocol: ternary @name("protocol");
            meta.source_port: ternary @name("sport");
            meta.destination_port: ternary @name("dport");
            meta.tcp_flags: ternary @name("tcp_flags");
            meta.icmp_type: ternary @name("icmp_type");
            meta.fragment: ternary @name("fragment");
        }
        actions = { limit_rate; @defaultonly no_limit; }
        const default_action = no_limit();
        meters = limit_meter;
        counters = limit_counter;
        size = 512;
    }
    @name(".ingress.limit_spared")
    @brief("Sources that get a rate of their own beyond a limit, because training knows them")
    table limit_spared {
        key = {
            limit_slot: exact @name("slot");
            meta.is_ipv4: exact @name("is_ipv4");
            meta.source: exact @name("src");
        }
        actions = { spare_source; @defaultonly spare_nobody; }
        const default_action = spare_nobody();
        meters = spared_meter;
        counters = spared_counter;
        size = 16384;
    }
    @name(".ingress.limit_over")
    @brief("Drops and counts what is over a limit")
    table limit_over {
        key = { limit_slot: exact @name("slot"); }
        actions = { drop_over; @defaultonly pass_over; }
        const default_action = pass_over();
        counters = over_counter;
        size = 256;
    }

    apply {
        limit.apply();
        if (color == METER_RED) {
            limit_spared.apply();
            if (color == METER_RED) {
                limit_over.apply();
            }
        }
    }
}
