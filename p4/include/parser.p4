// Ethernet, two VLAN tags, ARP, IPv4 with options, IPv6 with three extension headers, first fragments,
// TCP, UDP, ICMP and the ports that an ICMP error quotes.  What it cannot follow is accepted with
// l4_valid = 0 and the reason in `unparsed`: the BMv2 back end has no explicit reject.

parser FrameParser(packet_in packet, out headers_t hdr, inout metadata_t meta,
                   inout standard_metadata_t standard) {
    state start {
        meta.ingress_port = standard.ingress_port;
        meta.timestamp = standard.ingress_global_timestamp;
        meta.length = standard.packet_length;
        transition select(standard.ingress_port) {
            CPU_PORT: packet_out_header;
            default: ethernet;
        }
    }
    state packet_out_header {
        packet.extract(hdr.packet_out);
        transition select(hdr.packet_out.operation) {
            OPERATION_SEND: ethernet;
            default: accept;
        }
    }
    state ethernet {
        packet.extract(hdr.ethernet);
        meta.ethertype = hdr.ethernet.ethertype;
        transition select(hdr.ethernet.ethertype) {
            ETHERTYPE_VLAN: outer_vlan;
            ETHERTYPE_QINQ: outer_vlan;
            ETHERTYPE_ARP: arp;
            ETHERTYPE_IPV4: ipv4;
            ETHERTYPE_IPV6: ipv6;
            default: unknown_ethertype;
        }
    }
    state outer_vlan {
        packet.extract(hdr.vlan.next);
        meta.vid = hdr.vlan.last.vid;
        meta.ethertype = hdr.vlan.last.ethertype;
        transition select(hdr.vlan.last.ethertype) {
            ETHERTYPE_VLAN: inner_vlan;
            ETHERTYPE_QINQ: inner_vlan;
            ETHERTYPE_ARP: arp;
            ETHERTYPE_IPV4: ipv4;
            ETHERTYPE_IPV6: ipv6;
            default: unknown_ethertype;
        }
    }
    state inner_vlan {
        packet.extract(hdr.vlan.next);
        meta.ethertype = hdr.vlan.last.ethertype;
        transition select(hdr.vlan.last.ethertype) {
            ETHERTYPE_ARP: arp;
            ETHERTYPE_IPV4: ipv4;
            ETHERTYPE_IPV6: ipv6;
            default: unknown_ethertype;
        }
    }
    state arp {
        packet.extract(hdr.arp);
        meta.is_ipv4 = 1;
        meta.source = (address_t)hdr.arp.sender_ip;
        meta.destination = (address_t)hdr.arp.target_ip;
        meta.arp_operation = hdr.arp.operation;
        meta.arp_sender_mac = hdr.arp.sender_mac;
        meta.arp_target_mac = hdr.arp.target_mac;
        transition accept;
    }

    state ipv4 {
        packet.extract(hdr.ipv4);
        meta.is_ipv4 = 1;
        meta.source = (address_t)hdr.ipv4.source;
        meta.destination = (address_t)hdr.ipv4.destination;
        meta.protocol = hdr.ipv4.protocol;
        transition select(hdr.ipv4.version, hdr.ipv4.ihl) {
            (4, 5): ipv4_payload;
            (4, 6..15): ipv4_options;
            default: malformed;
        }
    }
    state ipv4_options {
        packet.extract(hdr.ipv4_options, (bit<32>)(((bit<16>)hdr.ipv4.ihl - 5) * 32));
        transition ipv4_payload;
    }
    state ipv4_payload {
        transition select(hdr.ipv4.fragment_offset, hdr.ipv4.flags) {
            (0, 1 &&& 1): first_fragment;
            (0, _): ipv4_protocol;
            default: later_fragment;
        }
    }
    state first_fragment {
        meta.fragment = 1;
        transition ipv4_protocol;
    }
    state later_fragment {
        meta.fragment = 2;
        transition accept;
    }
    state ipv4_protocol {
        transition select(hdr.ipv4.protocol) {
            PROTO_TCP: tcp;
            PROTO_UDP: udp;
            PROTO_ICMP: icmp;
            default: unknown_protocol;
        }
    }

    state ipv6 {
        packet.extract(hdr.ipv6);
        meta.source = hdr.ipv6.source;
        meta.destination = hdr.ipv6.destination;
        meta.protocol = hdr.ipv6.next_header;
        transition select(hdr.ipv6.version) {
            6: ipv6_payload;
            default: malformed;
        }
    }
    state ipv6_payload {
        transition select(hdr.ipv6.next_header) {
            PROTO_HOP_BY_HOP: extension0;
            PROTO_DESTINATION_OPTIONS: extension0;
            PROTO_ROUTING: extension0;
            PROTO_FRAGMENT: fragment;
            PROTO_TCP: tcp;
            PROTO_UDP: udp;
            PROTO_ICMPV6: icmpv6;
            PROTO_NO_NEXT: accept;
            default: unknown_protocol;
        }
    }
    state extension0 {
        packet.extract(hdr.extension0);
        packet.extract(hdr.extension0_rest, (bit<32>)hdr.extension0.length * 64);
        meta.protocol = hdr.extension0.next_header;
        transition select(hdr.extension0.next_header) {
            PROTO_DESTINATION_OPTIONS: extension1;
            PROTO_ROUTING: extension1;
            PROTO_FRAGMENT: fragment;
            PROTO_TCP: tcp;
            PROTO_UDP: udp;
            PROTO_ICMPV6: icmpv6;
            PROTO_NO_NEXT: accept;
            PROTO_HOP_BY_HOP: too_many_extensions;
            default: unknown_protocol;
        }
    }
    state extension1 {
        packet.extract(hdr.extension1);
        packet.extract(hdr.extension1_rest, (bit<32>)hdr.extension1.length * 64);
        meta.protocol = hdr.extension1.next_header;
        transition select(hdr.extension1.next_header) {
            PROTO_DESTINATION_OPTIONS: extension2;
            PROTO_ROUTING: extension2;
            PROTO_FRAGMENT: fragment;
            PROTO_TCP: tcp;
            PROTO_UDP: udp;
            PROTO_ICMPV6: icmpv6;
            PROTO_NO_NEXT: accept;
            PROTO_HOP_BY_HOP: too_many_extensions;
            default: unknown_protocol;
        }
    }
    state extension2 {
        packet.extract(hdr.extension2);
        packet.extract(hdr.extension2_rest, (bit<32>)hdr.extension2.length * 64);
        meta.protocol = hdr.extension2.next_header;
        transition select(hdr.extension2.next_header) {
            PROTO_FRAGMENT: fragment;
            PROTO_TCP: tcp;
            PROTO_UDP: udp;
            PROTO_ICMPV6: icmpv6;
            PROTO_NO_NEXT: accept;
            PROTO_HOP_BY_HOP: too_many_extensions;
            PROTO_DESTINATION_OPTIONS: too_many_extensions;
            PROTO_ROUTING: too_many_extensions;
            default: unknown_protocol;
        }
    }
    state fragment {
        packet.extract(hdr.fragment);
        meta.protocol = hdr.fragment.next_header;
        transition select(hdr.fragment.offset) {
            0: first_fragment_ipv6;
            default: later_fragment;
        }
    }
    state first_fragment_ipv6 {
        // an 'atomic' fragment (RFC 6946) is a whole packet
        meta.fragment = (bit<2>)hdr.fragment.more;
        transition select(hdr.fragment.next_header) {
            PROTO_TCP: tcp;
            PROTO_UDP: udp;
            PROTO_ICMPV6: icmpv6;
            PROTO_NO_NEXT: accept;
            PROTO_HOP_BY_HOP: too_many_extensions;
            PROTO_DESTINATION_OPTIONS: too_many_extensions;
            PROTO_ROUTING: too_many_extensions;
            default: unknown_protocol;
        }
    }

    state tcp {
        packet.extract(hdr.tcp);
        meta.l4_valid = 1;
        meta.source_port = hdr.tcp.source_port;
        meta.destination_port = hdr.tcp.destination_port;
        meta.tcp_flags = hdr.tcp.flags;
        meta.tcp_sequence = hdr.tcp.sequence;
        meta.tcp_acknowledgement = hdr.tcp.acknowledgement;
        transition accept;
    }
    state udp {
        packet.extract(hdr.udp);
        meta.l4_valid = 1;
        meta.source_port = hdr.udp.source_port;
        meta.destination_port = hdr.udp.destination_port;
        transition accept;
    }
    state icmp {
        packet.extract(hdr.icmp);
        meta.icmp_type = hdr.icmp.type;
        meta.icmp_code = hdr.icmp.code;
        meta.l4_valid = 1;
        transition select(hdr.icmp.type) {
            3: quoted_ipv4;
            4: quoted_ipv4;
            5: quoted_ipv4;
            11: quoted_ipv4;
            12: quoted_ipv4;
            default: accept;
        }
    }
    state icmpv6 {
        packet.extract(hdr.icmp);
        meta.icmp_type = hdr.icmp.type;
        meta.icmp_code = hdr.icmp.code;
        meta.l4_valid = 1;
        transition select(hdr.icmp.type) {
            1..4: quoted_ipv6;
            default: accept;
        }
    }
    state quoted_ipv4 {
        packet.extract(hdr.quoted_ipv4);
        transition select(hdr.quoted_ipv4.ihl) {
            5: quoted_ipv4_payload;
            6..15: quoted_ipv4_options;
            default: accept;
        }
    }
    state quoted_ipv4_options {
        packet.extract(hdr.quoted_ipv4_options, (bit<32>)(((bit<16>)hdr.quoted_ipv4.ihl - 5) * 32));
        transition quoted_ipv4_payload;
    }
    state quoted_ipv4_payload {
        meta.quoted_protocol = hdr.quoted_ipv4.protocol;
        transition select(hdr.quoted_ipv4.fragment_offset, hdr.quoted_ipv4.protocol) {
            (0, PROTO_TCP): quoted_ports;
            (0, PROTO_UDP): quoted_ports;
            default: accept;
        }
    }
    state quoted_ipv6 {
        packet.extract(hdr.quoted_ipv6);
        meta.quoted_protocol = hdr.quoted_ipv6.next_header;
        transition select(hdr.quoted_ipv6.next_header) {
            PROTO_TCP: quoted_ports;
            PROTO_UDP: quoted_ports;
            default: accept;
        }
    }
    state quoted_ports {
        packet.extract(hdr.quoted_ports);
        meta.quoted = 1;
        meta.source_port = hdr.quoted_ports.source_port;
        meta.destination_port = hdr.quoted_ports.destination_port;
        transition accept;
    }

    state unknown_ethertype {
        meta.unparsed = UNPARSED_ETHERTYPE;
        transition accept;
    }
    state unknown_protocol {
        meta.unparsed = UNPARSED_PROTOCOL;
        transition accept;
    }
    state too_many_extensions {
        meta.unparsed = UNPARSED_EXTENSIONS;
        transition accept;
    }
    state malformed {
        meta.unparsed = UNPARSED_MALFORMED;
        transition accept;
    }
}

control FrameDeparser(packet_out packet, in headers_t hdr) {
    apply {
        packet.emit(hdr.packet_in);
        packet.emit(hdr.ethernet);
        packet.emit(hdr.vlan);
        packet.emit(hdr.arp);
        packet.emit(hdr.ipv4);
        packet.emit(hdr.ipv4_options);
        packet.emit(hdr.ipv6);
        packet.emit(hdr.extension0);
        packet.emit(hdr.extension0_rest);
        packet.emit(hdr.extension1);
        packet.emit(hdr.extension1_rest);
        packet.emit(hdr.extension2);
        packet.emit(hdr.extension2_rest);
        packet.emit(hdr.fragment);
        packet.emit(hdr.tcp);
        packet.emit(hdr.udp);
        packet.emit(hdr.icmp);
        packet.emit(hdr.quoted_ipv4);
        packet.emit(hdr.quoted_ipv4_options);
        packet.emit(hdr.quoted_ipv6);
        packet.emit(hdr.quoted_ports);
    }
}
