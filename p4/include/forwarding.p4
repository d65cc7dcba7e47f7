// Where a frame goes: port to port (a wire), or by destination MAC per VLAN with flooding.  No routing.

control Forwarding(inout headers_t hdr, inout metadata_t meta, inout standard_metadata_t standard) {
    @name(".ingress.forward_port_counter") direct_counter(CounterType.packets_and_bytes) forward_port_counter;
    @name(".ingress.l2_forward_counter") direct_counter(CounterType.packets_and_bytes) l2_forward_counter;

    @name(".ingress.to_port") action to_port(bit<9> port) {
        standard.egress_spec = port;
        forward_port_counter.count();
    }
    @name(".ingress.no_wire") action no_wire() { forward_port_counter.count(); }
    @name(".ingress.to_station") action to_station(bit<9> port) {
        standard.egress_spec = port;
        l2_forward_counter.count();
    }
    @name(".ingress.unknown_station") action unknown_station() { l2_forward_counter.count(); }
    @name(".ingress.flood") action flood(bit<16> group) { standard.mcast_grp = group; }
    @name(".ingress.no_flood") action no_flood() { mark_to_drop(standard); }

    @name(".ingress.forward_port")
    @brief("Wires: what enters one port leaves through another")
    table forward_port {
        key = { meta.ingress_port: exact @name("ingress_port"); }
        actions = { to_port; @defaultonly no_wire; }
        const default_action = no_wire();
        counters = forward_port_counter;
        size = 512;
    }
    @name(".ingress.l2_forward")
    @brief("Stations by VLAN and MAC address")
    table l2_forward {
        key = {
            meta.vid: exact @name("vid");
            hdr.ethernet.destination: exact @name("eth_dst");
        }
        actions = { to_station; @defaultonly unknown_station; }
        const default_action = unknown_station();
        counters = l2_forward_counter;
        support_timeout = true;
        size = 16384;
    }
    @name(".ingress.l2_flood")
    @brief("Flood group of a VLAN; without one, frames to unknown stations are dropped")
    table l2_flood {
        key = { meta.vid: exact @name("vid"); }
        actions = { flood; @defaultonly no_flood; }
        const default_action = no_flood();
        size = 4096;
    }

    apply {
        if (!forward_port.apply().hit) {
            if (!l2_forward.apply().hit) {
                l2_flood.apply();
            }
        }
    }
}
