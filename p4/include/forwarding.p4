// Where a frame goes: port to port (a wire), or by destination MAC per VLAN with flooding.  No routing.
//
//   wire? ─ yes ─► its other end
//     │ no
//   station known in the VLAN? ─ yes ─► its port (not back to where it came from) ─┐
//     │ no                                                                         ├─► sender known there?
//   flood group of the VLAN, or of all? ─ yes ─► every port but its own ───────────┘     no: learn digest
//     │ no
//   drop
//
// Learning: the switch reports a sender that it does not know, or knows at another port; the controller
// enters it in `smac` and `dmac`, and takes both out when `smac` says that it has been silent.

control Forwarding(inout headers_t hdr, inout metadata_t meta, inout standard_metadata_t standard) {
    @name(".ingress.forward_port_counter") direct_counter(CounterType.packets_and_bytes) forward_port_counter;
    @name(".ingress.smac_counter") direct_counter(CounterType.packets) smac_counter;
    @name(".ingress.dmac_counter") direct_counter(CounterType.packets_and_bytes) dmac_counter;

    bit<1> leaves = 0;

    @name(".ingress.to_port") action to_port(bit<9> port) {
        standard.egress_spec = port;
        forward_port_counter.count();
    }
    @name(".ingress.no_wire") action no_wire() { forward_port_counter.count(); }
    @name(".ingress.set_egress") action set_egress(bit<9> port) {
        standard.egress_spec = port;
        leaves = 1;
        dmac_counter.count();
    }
    @name(".ingress.flood") action flood(bit<16> group) {
        standard.mcast_grp = group;
        leaves = 1;
        dmac_counter.count();
    }
    @name(".ingress.drop_unknown") action drop_unknown() {
        mark_to_drop(standard);
        dmac_counter.count();
    }
    @name(".ingress.flood_vlan") action flood_vlan(bit<16> group) {
        standard.mcast_grp = group;
        leaves = 1;
    }
    @name(".ingress.known_station") action known_station(bit<9> port) {
        meta.learns = meta.ingress_port == port ? 1w0 : 1w1;
        smac_counter.count();
    }
    @name(".ingress.learn") action learn() {
        meta.learns = hdr.ethernet.source[40:40] ^ 1; // a group address sends nothing
        smac_counter.count();
    }
    @name(".ingress.ignore") action ignore() { smac_counter.count(); }

    @name(".ingress.forward_port")
    @brief("Wires: what enters one port leaves through another")
    table forward_port {
        key = { meta.ingress_port: exact @name("ingress_port"); }
        actions = { to_port; @defaultonly no_wire; }
        const default_action = no_wire();
        counters = forward_port_counter;
        size = 512;
    }
    @name(".ingress.dmac")
    @brief("Stations by VLAN and MAC address; the default action floods to all, or drops")
    table dmac {
        key = {
            meta.vid: exact @name("vid");
            hdr.ethernet.destination: exact @name("eth_dst");
        }
        actions = { set_egress; flood; drop_unknown; }
        default_action = drop_unknown();
        counters = dmac_counter;
        support_timeout = true;
        size = 16384;
    }
    @name(".ingress.vlan_flood")
    @brief("Flood group of a VLAN, instead of what the default action of dmac does")
    table vlan_flood {
        key = { meta.vid: exact @name("vid"); }
        actions = { flood_vlan; NoAction; }
        default_action = NoAction();
        size = 4096;
    }
    @name(".ingress.smac")
    @brief("Known senders and their port; idle ones are reported. The default action reports new ones, or ignores them")
    table smac {
        key = {
            meta.vid: exact @name("vid");
            hdr.ethernet.source: exact @name("eth_src");
        }
        actions = { known_station; learn; ignore; }
        default_action = learn();
        counters = smac_counter;
        support_timeout = true;
        size = 16384;
    }

    apply {
        if (!forward_port.apply().hit) {
            if (!dmac.apply().hit) {
                vlan_flood.apply();
            } else if (standard.mcast_grp == 0 && standard.egress_spec == meta.ingress_port) {
                mark_to_drop(standard); // both stations are on the same side
            }
            if (leaves == 1 && hdr.ethernet.isValid()) {
                smac.apply();
            }
        }
    }
}
