// Every part of v1model that the embedded switch documents as supported, in a program small enough to
// reason about.  The first byte behind Ethernet selects what happens.
#include <core.p4>
#include <v1model.p4>

const bit<9> CPU_PORT = 510;
const bit<16> TYPE_TEST = 0x88b5;
const bit<16> TYPE_LABEL = 0x88b6;

@controller_header("packet_in")
header packet_in_t { bit<9> ingress_port; bit<7> reason; }
@controller_header("packet_out")
header packet_out_t { bit<9> egress_port; bit<7> pad; }
header ethernet_t { bit<48> dst; bit<48> src; bit<16> etype; }
header label_t { bit<20> label; bit<3> tc; bit<1> bottom; bit<8> ttl; }
header test_t { bit<8> what; bit<8> a; bit<8> b; bit<16> c; bit<32> d; bit<64> e; bit<16> result; }
header signed_t { int<8> x; int<8> y; int<8> sum; int<8> sat; bit<8> usum; bit<8> udiff; int<16> product; bit<8> shifted; }
header wide_t { bit<128> left; bit<128> right; bit<256> sum; bit<128> product; bit<512> joined; }
header ipv4_t {
    bit<4> version; bit<4> ihl; bit<8> tos; bit<16> len; bit<16> id; bit<3> flags; bit<13> frag;
    bit<8> ttl; bit<8> proto; bit<16> csum; bit<32> src; bit<32> dst;
}
header options_t { varbit<320> options; }
header trailer_t { bit<16> counted; bit<16> hashed; bit<32> crc; }

struct headers_t {
    packet_in_t packet_in; packet_out_t packet_out; ethernet_t eth; label_t[3] labels; test_t test;
    signed_t num; wide_t wide; ipv4_t ip; options_t options; trailer_t trailer;
}
struct meta_t {
    @field_list(1, 2) bit<8> rounds;
    @field_list(2) bit<9> from_port;
    @field_list(3) bit<32> mark;
    bit<32> index; bit<2> colour; bit<16> peek;
}
struct note_t { bit<9> port; bit<48> src; bit<32> mark; }
struct other_t { bit<8> what; bit<8> x; }

parser P(packet_in pkt, out headers_t h, inout meta_t m, inout standard_metadata_t sm) {
    state start { transition select(sm.ingress_port) { CPU_PORT: out_header; default: eth; } }
    state out_header { pkt.extract(h.packet_out); transition eth; }
    state eth {
        pkt.extract(h.eth);
        transition select(h.eth.etype) {
            TYPE_TEST: test; TYPE_LABEL: label; 0x0800: ip; 0x9000 &&& 0xf000: peek; default: accept;
        }
    }
    state label { pkt.extract(h.labels.next); transition select(h.labels.last.bottom) { 0: label; default: accept; } }
    state test {
        pkt.extract(h.test);
        verify(h.test.what != 0xff, error.ParserInvalidArgument);
        transition select(h.test.what, h.test.a) { (7, _): num; (8, 1..9): wide; default: accept; }
    }
    state num { pkt.extract(h.num); transition accept; }
    state wide { pkt.extract(h.wide); transition accept; }
    state peek { m.peek = pkt.lookahead<bit<16>>(); pkt.advance(16); transition select(m.peek) { 0x1234: trailer; default: accept; } }
    state trailer { pkt.extract(h.trailer); transition accept; }
    state ip { pkt.extract(h.ip); transition select(h.ip.ihl) { 5: accept; default: options; } }
    state options { pkt.extract(h.options, (bit<32>)(((bit<16>)h.ip.ihl - 5) * 32)); transition accept; }
}

control V(inout headers_t h, inout meta_t m) {
    apply {
        verify_checksum(h.ip.isValid(), { h.ip.version, h.ip.ihl, h.ip.tos, h.ip.len, h.ip.id, h.ip.flags, h.ip.frag,
            h.ip.ttl, h.ip.proto, h.ip.src, h.ip.dst, h.options.options }, h.ip.csum, HashAlgorithm.csum16);
    }
}

control I(inout headers_t h, inout meta_t m, inout standard_metadata_t sm) {
    counter(16, CounterType.packets_and_bytes) seen;
    meter(16, MeterType.packets) rate;
    direct_counter(CounterType.packets_and_bytes) route_hits;
    direct_meter<bit<2>>(MeterType.bytes) flow_rate;
    register<bit<64>>(8) cells;
    register<bit<200>>(4) wide_cells;

    action forward(bit<9> port) { sm.egress_spec = port; }
    action drop() { mark_to_drop(sm); }
    action flood(bit<16> group) { sm.mcast_grp = group; }
    action counted(bit<9> port) { sm.egress_spec = port; route_hits.count(); }
    action metered(bit<9> port) { sm.egress_spec = port; flow_rate.read(m.colour); }
    action stop() { mark_to_drop(sm); exit; }
    action label_as(bit<8> value, bit<32> mark) { h.test.b = value; m.mark = mark; }

    table route { key = { h.ip.dst: lpm; } actions = { counted; drop; NoAction; } default_action = drop(); size = 64; counters = route_hits; support_timeout = true; }
    table ports { key = { sm.ingress_port: exact; } actions = { forward; flood; stop; NoAction; } default_action = NoAction(); size = 16; }
    table flows { key = { h.test.c: range; h.test.d: ternary; h.test.a: exact; } actions = { metered; drop; NoAction; } default_action = NoAction(); size = 64; meters = flow_rate; }
    table maybe { key = { h.test.b: optional; h.test.c: range; } actions = { label_as; NoAction; } default_action = NoAction(); size = 16; }
    table fixed {
        key = { h.test.a: exact; h.test.b: ternary; } actions = { label_as; drop; NoAction; } default_action = NoAction();
        const entries = { (1, 0x10 &&& 0xf0): label_as(0x11, 1); (1, _): label_as(0x22, 2); (2, 5): drop(); }
    }

    apply {
        ports.apply();
        seen.count((bit<32>)sm.ingress_port & 15);
        if (h.packet_out.isValid()) { sm.egress_spec = h.packet_out.egress_port; h.packet_out.setInvalid(); }
        else if (h.ip.isValid()) {
            if (route.apply().hit) { h.ip.ttl = h.ip.ttl |-| 1; }
            if (sm.checksum_error == 1) { h.ip.tos = 0xff; }
        } else if (h.labels[0].isValid()) {
            if (h.labels[0].label == 1) { h.labels.pop_front(1); }
            else if (h.labels[0].label == 2) { h.labels.push_front(1); h.labels[0].setValid(); h.labels[0].label = 77; h.labels[0].bottom = 0; }
            else if (h.labels[0].label == 3) { h.labels[1] = h.labels[0]; h.labels[0].ttl = h.labels[0].ttl - 1; }
            else if (h.labels[0].label == 4) { h.labels[2].setInvalid(); }
        } else if (h.trailer.isValid()) {
            h.trailer.counted = (bit<16>)sm.packet_length;
            hash(h.trailer.hashed, HashAlgorithm.crc16, 16w100, { h.eth.src, h.eth.dst, sm.packet_length, 3w5 }, 16w1000);
            hash(h.trailer.crc, HashAlgorithm.crc32, 32w0, { h.eth.etype, m.peek }, 33w0x100000000);
        } else if (h.test.isValid()) {
            if (h.test.what == 1) { clone_preserving_field_list(CloneType.I2E, 5, 3); m.mark = h.test.d; }
            if (h.test.what == 1) { clone_preserving_field_list(CloneType.I2E, 5, 3); }
            if (h.test.what == 2 && m.rounds < h.test.a) { m.rounds = m.rounds + 1; m.from_port = sm.ingress_port; resubmit_preserving_field_list(2); }
            if (h.test.what == 2) { h.test.b = m.rounds; h.test.c = (bit<16>)m.from_port; h.test.d = sm.instance_type; }
            if (h.test.what == 3) { cells.read(h.test.e, (bit<32>)h.test.a & 7); cells.write((bit<32>)h.test.a & 7, h.test.e + (bit<64>)h.test.d); }
            if (h.test.what == 4) { bit<200> w; wide_cells.read(w, (bit<32>)h.test.a & 3); w = (w << 8) ^ (bit<200>)h.test.d; wide_cells.write((bit<32>)h.test.a & 3, w); h.test.e = w[130:67]; h.test.result = (bit<16>)(w >> 184); }
            if (h.test.what == 5) { rate.execute_meter((bit<32>)h.test.a & 15, m.colour); h.test.b = (bit<8>)m.colour; }
            if (h.test.what == 6) {
                switch (flows.apply().action_run) { metered: { h.test.b = (bit<8>)m.colour; } drop: { digest<other_t>(1, { h.test.what, 8w253 }); } default: { h.test.b = 0xee; } }
            }
            if (h.test.what == 9) { maybe.apply(); h.test.d = m.mark; }
            if (h.test.what == 10) { fixed.apply(); h.test.d = m.mark; }
            if (h.test.what == 11) { m.mark = h.test.d; digest<note_t>(1, { sm.ingress_port, h.eth.src, m.mark }); }
            if (h.test.what == 12) { truncate((bit<32>)h.test.a); }
            if (h.test.what == 13) { if (sm.parser_error == error.ParserInvalidArgument) { h.test.result = 6; } h.test.setInvalid(); h.test.setValid(); h.test.what = 13; h.test.c = (bit<16>)sm.packet_length; }
            if (h.test.what == 14) { hash(h.test.result, HashAlgorithm.identity, (bit<16>)h.test.a, { h.test.e, h.test.d }, h.test.c); }
            if (h.test.what == 15) { h.test.e = (bit<64>)sm.ingress_global_timestamp; h.packet_in.setValid(); h.packet_in.ingress_port = sm.ingress_port; h.packet_in.reason = 3; sm.egress_spec = CPU_PORT; }
            if (h.test.what == 16) { h.test.e = h.test.e << h.test.a; h.test.d = h.test.d >> h.test.b; h.test.c = (h.test.c * h.test.c) ^ ~h.test.c; h.test.result = h.test.c - (bit<16>)h.test.a; h.test.b = (h.test.a > h.test.b) ? 8w1 : 8w0; }
            // beyond the arrays on purpose: not for a BMv2 built for release, which does not look
            if (h.test.what == 21) { cells.read(h.test.e, h.test.d); cells.write(h.test.d, h.test.e); wide_cells.write(h.test.d, 1); rate.execute_meter(h.test.d, m.colour); seen.count(h.test.d); h.test.b = (bit<8>)m.colour; }
            if (h.num.isValid()) {
                h.num.sum = h.num.x + h.num.y; h.num.sat = h.num.x |+| h.num.y;
                h.num.usum = (bit<8>)h.num.x |+| (bit<8>)h.num.y; h.num.udiff = (bit<8>)h.num.x |-| (bit<8>)h.num.y;
                h.num.product = (int<16>)h.num.x * (int<16>)h.num.y;
                h.num.shifted = (bit<8>)(h.num.x >> 2);
                if (h.num.x < h.num.y) { h.test.result = 1; } else if (h.num.x == -128) { h.test.result = 2; }
            }
            if (h.wide.isValid()) {
                h.wide.sum = (bit<256>)h.wide.left + ((bit<256>)h.wide.right << 64);
                h.wide.product = h.wide.left * h.wide.right;
                h.wide.joined = h.wide.left ++ h.wide.right ++ (h.wide.sum - 1);
                if (h.wide.left > h.wide.right) { h.test.result = 1; } else if (h.wide.sum >= (bit<256>)h.wide.right) { h.test.result = 2; }
            }
        }
    }
}

control E(inout headers_t h, inout meta_t m, inout standard_metadata_t sm) {
    apply {
        if (h.test.isValid()) {
            if (sm.instance_type != 0 && sm.instance_type != 6) { h.test.result = (bit<8>)sm.instance_type ++ (bit<8>)sm.egress_rid; }
            if (sm.instance_type == 1) { h.test.d = m.mark + 1; h.test.c = (bit<16>)sm.packet_length; truncate(60); }
            if (sm.instance_type == 2) { h.test.d = m.mark; }
            if (h.test.what == 17 && sm.instance_type == 0) { m.mark = 99; clone_preserving_field_list(CloneType.E2E, 6, 3); h.test.b = 0x44; }
            if (h.test.what == 18 && m.rounds < h.test.a) { m.rounds = m.rounds + 1; h.test.c = h.test.c + 1; recirculate_preserving_field_list(1); }
            if (h.test.what == 19 && sm.egress_port == 3) { mark_to_drop(sm); }
        }
    }
}

control C(inout headers_t h, inout meta_t m) {
    apply {
        update_checksum(h.ip.isValid(), { h.ip.version, h.ip.ihl, h.ip.tos, h.ip.len, h.ip.id, h.ip.flags, h.ip.frag,
            h.ip.ttl, h.ip.proto, h.ip.src, h.ip.dst, h.options.options }, h.ip.csum, HashAlgorithm.csum16);
        update_checksum_with_payload(h.test.isValid() && h.test.what == 20, { h.test.what, h.test.a }, h.test.result, HashAlgorithm.csum16);
    }
}
control D(packet_out pkt, in headers_t h) {
    apply {
        pkt.emit(h.packet_in); pkt.emit(h.eth); pkt.emit(h.labels); pkt.emit(h.test); pkt.emit(h.num); pkt.emit(h.wide);
        pkt.emit(h.ip); pkt.emit(h.options); pkt.emit(h.trailer);
    }
}
V1Switch(P(), V(), I(), E(), C(), D()) main;
