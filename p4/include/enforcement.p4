// Who may send at all, and how much.  `allow` always wins; a blocked frame is neither forwarded nor copied, and
// neither is one that is over a rate limit.
// Frames that the parser cannot take apart are counted by cause, and pass unless the cause has an entry.

control Enforcement(inout headers_t hdr, inout metadata_t meta, in standard_metadata_t standard) {
    @name(".ingress.allow_counter") direct_counter(CounterType.packets_and_bytes) allow_counter;
    @name(".ingress.block_src_counter") direct_counter(CounterType.packets_and_bytes) block_src_counter;
    @name(".ingress.block_mac_counter") direct_counter(CounterType.packets_and_bytes) block_mac_counter;
    @name(".ingress.block_counter") direct_counter(CounterType.packets_and_bytes) block_counter;
    @name(".ingress.unparsed_counter") direct_counter(CounterType.packets_and_bytes) unparsed_counter;
    @name(".ingress.unparsed_frames") counter(8, CounterType.packets_and_bytes) unparsed_frames;

    RateLimits() rate_limits;

    @name(".ingress.allow_frame") action allow_frame() { allow_counter.count(); }
    @name(".ingress.no_allow") action no_allow() { allow_counter.count(); }
    @name(".ingress.drop_src") action drop_src() { meta.blocked = 1; block_src_counter.count(); }
    @name(".ingress.pass_src") action pass_src() { block_src_counter.count(); }
    @name(".ingress.drop_mac") action drop_mac() { meta.blocked = 1; block_mac_counter.count(); }
    @name(".ingress.pass_mac") action pass_mac() { block_mac_counter.count(); }
    @name(".ingress.drop_frame") action drop_frame() { meta.blocked = 1; block_counter.count(); }
    @name(".ingress.pass_frame") action pass_frame() { block_counter.count(); }
    @name(".ingress.drop_unparsed") action drop_unparsed() { meta.blocked = 1; unparsed_counter.count(); }
    @name(".ingress.pass_unparsed") action pass_unparsed() { unparsed_counter.count(); }
    @name(".ingress.count_unparsed") action count_unparsed() {
        unparsed_frames.count((bit<32>)meta.unparsed);
        meta.l4_valid = 0;
    }

    @name(".ingress.allow")
    @brief("Senders and services that no block may touch")
    table allow {
        key = {
            meta.ingress_port: ternary @name("ingress_port");
            hdr.ethernet.source: ternary @name("eth_src");
            meta.is_ipv4: ternary @name("is_ipv4");
            meta.source: ternary @name("src");
            meta.destination: ternary @name("dst");
            meta.protocol: ternary @name("protocol");
            meta.destination_port: ternary @name("dport");
        }
        actions = { allow_frame; @defaultonly no_allow; }
        const default_action = no_allow();
        counters = allow_counter;
        size = 1024;
    }
    @name(".ingress.block_src")
    @brief("Blocked source addresses; the sender address of ARP counts as source")
    table block_src {
        key = {
            meta.is_ipv4: exact @name("is_ipv4");
            meta.source: exact @name("src");
        }
        actions = { drop_src; @defaultonly pass_src; }
        const default_action = pass_src();
        counters = block_src_counter;
        support_timeout = true;
        size = 16384;
    }
    @name(".ingress.block_mac")
    @brief("Blocked stations: a MAC address on a port")
    table block_mac {
        key = {
            meta.ingress_port: exact @name("ingress_port");
            hdr.ethernet.source: exact @name("eth_src");
        }
        actions = { drop_mac; @defaultonly pass_mac; }
        const default_action = pass_mac();
        counters = block_mac_counter;
        support_timeout = true;
        size = 16384;
    }
    @name(".ingress.block")
    @brief("Blocks by any header field; few, since BMv2 looks ternary entries up one by one")
    table block {
        key = {
            meta.ingress_port: ternary @name("ingress_port");
            hdr.ethernet.source: ternary @name("eth_src");
            hdr.ethernet.destination: ternary @name("eth_dst");
            meta.ethertype: ternary @name("ethertype");
            meta.vid: ternary @name("vid");
            meta.is_ipv4: ternary @name("is_ipv4");
            meta.source: ternary @name("src");
            meta.destination: ternary @name("dst");
            meta.protocol: ternary @name("protocol");
            meta.source_port: ternary @name("sport");
            meta.destination_port: ternary @name("dport");
            meta.fragment: ternary @name("fragment");
        }
        actions = { drop_frame; @defaultonly pass_frame; }
        const default_action = pass_frame();
        counters = block_counter;
        support_timeout = true;
        size = 1024;
    }
    @name(".ingress.unparsed")
    @brief("Frames that the parser cannot take apart, by cause: they pass where no entry drops them")
    table unparsed {
        key = { meta.unparsed: exact @name("cause"); }
        actions = { drop_unparsed; pass_unparsed; }
        default_action = pass_unparsed();
        counters = unparsed_counter;
        size = 8;
    }

    apply {
        if (standard.parser_error != error.NoError) {
            meta.unparsed = UNPARSED_CUT;
        }
        if (meta.unparsed != UNPARSED_NOTHING) {
            count_unparsed();
        }
        if (!allow.apply().hit) {
            if (!block_src.apply().hit) {
                if (!block_mac.apply().hit) {
                    if (!block.apply().hit) {
                        if (meta.unparsed != UNPARSED_NOTHING) {
                            unparsed.apply();
                        }
                    }
                }
            }
            if (meta.blocked == 0) {
                rate_limits.apply(meta);
            }
        }
    }
}
