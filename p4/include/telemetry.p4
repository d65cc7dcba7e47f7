// Which queries want this frame?  A bit-vector classifier: one table for each field gives the 256-bit
// map of the queries whose condition on that field holds; the maps are ANDed.  An entry carries the
// bits of every wider entry that covers it, the default action those of queries that do not look at
// the field.  A query comes in by its field entries first and its `active` bit last, and leaves in the
// reverse order, so that no frame sees half a query.

control Telemetry(inout headers_t hdr, inout metadata_t meta) {
    @name(".ingress.telemetry_counter") direct_counter(CounterType.packets_and_bytes) active_counter;

    @name(".ingress.match_link") action match_link(query_map_t queries) { meta.query_map = queries; }
    @name(".ingress.match_src") action match_src(query_map_t queries) { meta.query_map = meta.query_map & queries; }
    @name(".ingress.match_dst") action match_dst(query_map_t queries) { meta.query_map = meta.query_map & queries; }
    @name(".ingress.match_l4") action match_l4(query_map_t queries) { meta.query_map = meta.query_map & queries; }
    @name(".ingress.match_sport") action match_sport(query_map_t queries) { meta.query_map = meta.query_map & queries; }
    @name(".ingress.match_dport") action match_dport(query_map_t queries) { meta.query_map = meta.query_map & queries; }
    @name(".ingress.set_active") action set_active(query_map_t active, query_map_t copies, query_map_t digests) {
        meta.query_map = meta.query_map & active;
        meta.copies = meta.query_map & copies;
        meta.digests = meta.query_map & digests;
        active_counter.count();
    }

    @name(".ingress.telemetry_link")
    @brief("Queries by ingress port, VLAN and EtherType")
    table telemetry_link {
        key = {
            meta.ingress_port: ternary @name("ingress_port");
            meta.vid: ternary @name("vid");
            meta.ethertype: ternary @name("ethertype");
        }
        actions = { match_link; }
        default_action = match_link(0);
        size = 256;
    }
    @name(".ingress.telemetry_src")
    @brief("Queries by source prefix")
    table telemetry_src {
        key = {
            meta.is_ipv4: exact @name("is_ipv4");
            meta.source: lpm @name("src");
        }
        actions = { match_src; }
        default_action = match_src(0);
        size = 1024;
    }
    @name(".ingress.telemetry_dst")
    @brief("Queries by destination prefix")
    table telemetry_dst {
        key = {
            meta.is_ipv4: exact @name("is_ipv4");
            meta.destination: lpm @name("dst");
        }
        actions = { match_dst; }
        default_action = match_dst(0);
        size = 1024;
    }
    @name(".ingress.telemetry_l4")
    @brief("Queries by protocol, TCP flags and fragment class")
    table telemetry_l4 {
        key = {
            meta.protocol: ternary @name("protocol");
            meta.tcp_flags: ternary @name("tcp_flags");
            meta.l4_valid: ternary @name("l4_valid");
            meta.fragment: ternary @name("fragment");
        }
        actions = { match_l4; }
        default_action = match_l4(0);
        size = 256;
    }
    @name(".ingress.telemetry_sport")
    @brief("Queries by source port range")
    table telemetry_sport {
        key = { meta.source_port: range @name("sport"); }
        actions = { match_sport; }
        default_action = match_sport(0);
        size = 512;
    }
    @name(".ingress.telemetry_dport")
    @brief("Queries by destination port range")
    table telemetry_dport {
        key = { meta.destination_port: range @name("dport"); }
        actions = { match_dport; }
        default_action = match_dport(0);
        size = 512;
    }
    @name(".ingress.telemetry_active")
    @brief("Queries that are in force, and which of them want packet-ins or digests")
    table telemetry_active {
        key = { }
        actions = { set_active; }
        default_action = set_active(0, 0, 0);
        counters = active_counter;
    }

    apply {
        telemetry_link.apply();
        telemetry_src.apply();
        telemetry_dst.apply();
        telemetry_l4.apply();
        telemetry_sport.apply();
        telemetry_dport.apply();
        telemetry_active.apply();
    }
}
