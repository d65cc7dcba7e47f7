/* The switch program of SDNator, for the v1model architecture (BMv2 and the embedded target).
 *
 *   frame ─► parser ─► admission ─► enforcement ─► telemetry ─► forwarding ─► egress ─► deparser
 *                      numbers      allow, blocks   which        port to       packet-in
 *                      the frame    (no copy of     queries      port, or      header on
 *                                   a blocked one)  want it?     L2 per VLAN   copies
 *
 * Tables are named ingress.<table> whatever control they stand in, so that a control plane need not
 * know how the program is cut into files.
 */
#include <core.p4>
#include <v1model.p4>

#include "include/headers.p4"
#include "include/parser.p4"
#include "include/enforcement.p4"
#include "include/telemetry.p4"
#include "include/forwarding.p4"

control FrameVerify(inout headers_t hdr, inout metadata_t meta) {
    apply { /* captures carry offload errors: a wrong checksum is no reason to drop */ }
}

control FrameIngress(inout headers_t hdr, inout metadata_t meta, inout standard_metadata_t standard) {
    // [0] frames that came in from outside, [1] packet-ins made
    @name(".ingress.frame_numbers")
    register<bit<32>>(2) frame_numbers;

    Enforcement() enforcement;
    Telemetry() telemetry;
    Forwarding() forwarding;

    apply {
        if (hdr.packet_out.isValid()) {
            standard.egress_spec = hdr.packet_out.egress_port;
            hdr.packet_out.setInvalid();
        } else {
            frame_numbers.read(meta.arrival, 0);
            frame_numbers.write(0, meta.arrival + 1);
            enforcement.apply(hdr, meta);
            if (meta.blocked == 1) {
                mark_to_drop(standard);
            } else {
                forwarding.apply(hdr, meta, standard);
                telemetry.apply(hdr, meta);
                if (meta.copies != 0) {
                    frame_numbers.read(meta.sequence, 1);
                    meta.sequence = meta.sequence + 1;
                    frame_numbers.write(1, meta.sequence);
                    clone_preserving_field_list(CloneType.I2E, COPY_SESSION, COPY_FIELDS);
                }
            }
        }
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
        } else if (standard.instance_type == INSTANCE_REPLICATION
                   && standard.egress_port == meta.ingress_port) {
            mark_to_drop(standard); // a flooded frame does not go back where it came from
        }
    }
}

control FrameChecksum(inout headers_t hdr, inout metadata_t meta) {
    apply { /* nothing is rewritten */ }
}

V1Switch(FrameParser(), FrameVerify(), FrameIngress(), FrameEgress(), FrameChecksum(), FrameDeparser()) main;
