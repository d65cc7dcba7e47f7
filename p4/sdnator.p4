/* The switch program of SDNator, for the v1model architecture (BMv2 and the embedded target).
 *
 *   frame ─► parser ─► number ─► enforcement ─► SYN guard ─► forwarding ─► telemetry ─► egress ─► deparser
 *                      it        allow, blocks, challenges   port to       which        packet-in
 *                                rate limits    unknown      port, or      queries      header on
 *                                (no copy of    sources      L2 per VLAN   want it?     copies
 *                                what it drops)
 *
 * Tables are named ingress.<table> whatever control they stand in, so that a control plane need not
 * know how the program is cut into files.
 */
#include <core.p4>
#include <v1model.p4>

#include "include/headers.p4"
#include "include/parser.p4"
#include "include/rate_limits.p4"
#include "include/enforcement.p4"
#include "include/syn_guard.p4"
#include "include/telemetry.p4"
#include "include/counting.p4"
#include "include/forwarding.p4"

control FrameVerify(inout headers_t hdr, inout metadata_t meta) {
    apply { /* captures carry offload errors: a wrong checksum is no reason to drop */ }
}

control FrameIngress(inout headers_t hdr, inout metadata_t meta, inout standard_metadata_t standard) {
    // [0] frames that came in from outside, [1] packet-ins made
    @name(".ingress.frame_numbers")
    register<bit<32>>(2) frame_numbers;

    Enforcement() enforcement;
    SynGuard() syn_guard;
    Forwarding() forwarding;
    Telemetry() telemetry;
    Counting() counting;
    Sweep() sweep;

    // The controller asks for the count of a key, or for those that wait for a window's end: the answer goes
    // back to it in band, because BMv2 lets nobody read a register through P4Runtime.
    action prepare_reading() {
        meta.reading = 1;
        meta.query_map = 256w1 << hdr.packet_out.query[7:0];
        meta.source = hdr.packet_out.key_source;
        meta.destination = hdr.packet_out.key_destination;
        meta.destination_port = hdr.packet_out.key_port;
        meta.length = (bit<32>)hdr.packet_out.key_length;
        meta.source_port = hdr.packet_out.key_source_port;
        if (hdr.packet_out.operation == OPERATION_READ_CELL || hdr.packet_out.timestamp != 0) {
            meta.timestamp = hdr.packet_out.timestamp;
        }
    }
    action answer_reading() {
        hdr.packet_in.setValid();
        hdr.packet_in.ingress_port = CPU_PORT;
        hdr.packet_in.reason = REASON_CELL;
        hdr.packet_in.timestamp = meta.timestamp;
        hdr.packet_in.length = hdr.packet_out.query;
        if (hdr.packet_out.operation == OPERATION_SWEEP) {
            hdr.packet_in.sequence = (bit<32>)meta.sweep.left;
            hdr.packet_in.arrival = 0;
        } else {
            hdr.packet_in.sequence = meta.cell_count;
            hdr.packet_in.arrival = meta.cell_epoch |-| 1;
        }
        hdr.packet_in.query_map = meta.overflow;
        standard.egress_spec = CPU_PORT;
    }

    action make_digest() {
        digest<frame_digest_t>(1, {
            meta.digests, meta.crossed, meta.overflow, meta.timestamp, meta.arrival, meta.sequence,
            meta.ingress_port, meta.vid, meta.ethertype, meta.length,
            hdr.ethernet.source, hdr.ethernet.destination, meta.is_ipv4, meta.source, meta.destination,
            meta.protocol, meta.fragment, meta.l4_valid, meta.quoted, meta.quoted_protocol,
            meta.source_port, meta.destination_port, meta.tcp_flags,
            meta.tcp_sequence, meta.tcp_acknowledgement, meta.icmp_type, meta.icmp_code,
            meta.arp_operation, meta.arp_sender_mac, meta.arp_target_mac
        });
    }

    // A frame makes one digest at most (of two, BMv2 sends the last): who is learnt goes first, and whoever
    // wanted a digest of the frame gets a copy of it instead.  What was counted cannot be said otherwise.
    action make_learn_digest() {
        digest<learn_digest_t>(1, { hdr.ethernet.source, meta.ingress_port, meta.timestamp, meta.vid });
        meta.copies = meta.copies | meta.digests;
        meta.digests = 0;
    }

    action number_frame() {
        frame_numbers.read(meta.arrival, 0);
        frame_numbers.write(0, meta.arrival + 1);
    }
    action number_copy() {
        frame_numbers.read(meta.sequence, 1);
        meta.sequence = meta.sequence + 1;
        frame_numbers.write(1, meta.sequence);
    }

    apply {
        if (hdr.packet_out.isValid() && hdr.packet_out.operation != OPERATION_READ_CELL
                && hdr.packet_out.operation != OPERATION_SWEEP) {
            standard.egress_spec = hdr.packet_out.egress_port;
        } else {
            if (hdr.packet_out.isValid()) {
                prepare_reading();
            } else {
                number_frame();
                enforcement.apply(hdr, meta, standard);
                if (meta.blocked == 0) {
                    syn_guard.apply(hdr, meta, standard);
                }
                if (meta.blocked == 1) {
                    mark_to_drop(standard);
                } else if (meta.answered == 0) {
                    forwarding.apply(hdr, meta, standard);
                    telemetry.apply(hdr, meta);
                }
            }
            if (meta.query_map != 0) {
                counting.apply(hdr, meta);
            }
            // a frame that makes a digest of its own leaves the ring to the next one
            if (meta.sweep.size != 0 && (meta.reading == 1 ? hdr.packet_out.operation == OPERATION_SWEEP
                    : meta.crossed == 0 && meta.overflow == 0 && meta.learns == 0)) {
                sweep.apply(meta);
            }
            if (meta.reading == 1) {
                if (hdr.packet_out.operation == OPERATION_READ_CELL || hdr.packet_out.key_length == 1 || meta.sweep.left == 1) {
                    answer_reading();
                } else {
                    mark_to_drop(standard);
                }
            } else {
                if (meta.learns == 1 && meta.crossed == 0 && meta.overflow == 0) {
                    make_learn_digest();
                }
                if (meta.copies != 0 || meta.digests != 0) {
                    number_copy();
                }
                if (meta.copies != 0) {
                    clone_preserving_field_list(CloneType.I2E, COPY_SESSION, COPY_FIELDS);
                }
                if (meta.digests != 0 || meta.crossed != 0 || meta.overflow != 0) {
                    make_digest();
                }
            }
        }
        hdr.packet_out.setInvalid();
    }
}

control FrameEgress(inout headers_t hdr, inout metadata_t meta, inout standard_metadata_t standard) {
    apply {
        if (standard.instance_type == INSTANCE_INGRESS_CLONE) {
            hdr.packet_in.setValid();
            hdr.packet_in.ingress_port = meta.ingress_port;
            hdr.packet_in.reason = meta.reason;
            hdr.packet_in.timestamp = meta.timestamp;
            hdr.packet_in.length = meta.length;
            hdr.packet_in.sequence = meta.sequence;
            hdr.packet_in.arrival = meta.arrival;
            hdr.packet_in.query_map = meta.query_map;
            truncate(PACKET_IN_HEADER_BYTES + COPY_BYTES);
        } else if (meta.answered == 1) {
            truncate(hdr.ipv4.isValid() ? ETHERNET_BYTES + 40 : ETHERNET_BYTES + 60); // no payload of the SYN
        } else if (standard.instance_type == INSTANCE_REPLICATION
                   && standard.egress_port == meta.ingress_port) {
            mark_to_drop(standard); // a flooded frame does not go back where it came from
        }
    }
}

V1Switch(FrameParser(), FrameVerify(), FrameIngress(), FrameEgress(), FrameChecksum(), FrameDeparser()) main;
