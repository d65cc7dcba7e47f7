// Headers, metadata and the constants that the control plane shares with the program.

const bit<9> CPU_PORT = 510;
const bit<32> COPY_SESSION = 1;           // clone session towards the controller
const bit<32> COPY_BYTES = 256;           // of a copied frame: all headers, those quoted by ICMP errors too
const bit<32> PACKET_IN_HEADER_BYTES = 52;
const bit<32> ETHERNET_BYTES = 14;
#define COPY_FIELDS 1

const bit<32> INSTANCE_INGRESS_CLONE = 1; // BMv2's numbers for standard_metadata.instance_type
const bit<32> INSTANCE_REPLICATION = 5;

const bit<7> OPERATION_SEND = 0;
const bit<7> OPERATION_READ_CELL = 1;
const bit<7> OPERATION_SWEEP = 2;         // as a frame of the query would, after its last frame for a while

// metadata_t.unparsed, and index of unparsed_frames: what the parser could not take apart, and why
const bit<3> UNPARSED_NOTHING = 0;        // all of it was taken apart
const bit<3> UNPARSED_CUT = 1;            // the frame ends within a header
const bit<3> UNPARSED_MALFORMED = 2;      // IP of another version than its EtherType says, or no IPv4 header length
const bit<3> UNPARSED_EXTENSIONS = 3;     // more IPv6 extension headers, or in another order, than are followed
const bit<3> UNPARSED_PROTOCOL = 4;       // neither TCP, UDP nor ICMP above IP
const bit<3> UNPARSED_ETHERTYPE = 5;      // neither IP nor ARP, or a third VLAN tag

// packet_in.reason: 0 = a telemetry query wants the frame
const bit<7> REASON_CELL = 1;             // answer to OPERATION_READ_CELL: sequence = count, arrival = window;
                                          // to OPERATION_SWEEP: sequence = 1 if more keys wait for it

const bit<16> ETHERTYPE_IPV4 = 0x0800;
const bit<16> ETHERTYPE_ARP = 0x0806;
const bit<16> ETHERTYPE_VLAN = 0x8100;
const bit<16> ETHERTYPE_QINQ = 0x88a8;
const bit<16> ETHERTYPE_IPV6 = 0x86dd;

const bit<8> PROTO_HOP_BY_HOP = 0;
const bit<8> PROTO_ICMP = 1;
const bit<8> PROTO_TCP = 6;
const bit<8> PROTO_UDP = 17;
const bit<8> PROTO_ROUTING = 43;
const bit<8> PROTO_FRAGMENT = 44;
const bit<8> PROTO_ICMPV6 = 58;
const bit<8> PROTO_NO_NEXT = 59;
const bit<8> PROTO_DESTINATION_OPTIONS = 60;

const bit<2> METER_GREEN = 0;             // v1model's colours; 1 is yellow
const bit<2> METER_RED = 2;

typedef bit<48> mac_t;
typedef bit<128> address_t;               // IPv6, or IPv4 in the low 32 bits
typedef bit<256> query_map_t;             // one bit for each telemetry query

@controller_header("packet_in")
header packet_in_t {
    bit<9> ingress_port;
    bit<7> reason;
    bit<48> timestamp;                    // us on the switch's clock
    bit<32> length;                       // bytes on the wire
    bit<32> sequence;                     // of this packet-in, from 1: a gap is a loss
    bit<32> arrival;                      // of the frame at the switch, from 0
    query_map_t query_map;                // queries that the frame matched
}

@controller_header("packet_out")
header packet_out_t {
    bit<9> egress_port;
    bit<7> operation;                     // 0: send the frame out of egress_port; 1: read a counting cell;
                                          // 2: sweep a ring, answered where more is left, or key_length is 1
    bit<32> query;                        // number of the query, and its key, masked as the query masks it
    address_t key_source;
    address_t key_destination;
    bit<16> key_port;
    bit<16> key_length;
    bit<16> key_source_port;
    bit<48> timestamp;                    // any time in the window that is asked for, us; 2: 0 = now
}

header ethernet_t { mac_t destination; mac_t source; bit<16> ethertype; }
header vlan_t { bit<3> priority; bit<1> drop_eligible; bit<12> vid; bit<16> ethertype; }
header arp_t {
    bit<16> hardware_type; bit<16> protocol_type; bit<8> hardware_length; bit<8> protocol_length;
    bit<16> operation;
    mac_t sender_mac; bit<32> sender_ip; mac_t target_mac; bit<32> target_ip;
}
header ipv4_t {
    bit<4> version; bit<4> ihl; bit<8> tos; bit<16> total_length;
    bit<16> identification; bit<3> flags; bit<13> fragment_offset;
    bit<8> ttl; bit<8> protocol; bit<16> checksum; bit<32> source; bit<32> destination;
}
header ipv4_options_t { varbit<320> options; }
header ipv6_t {
    bit<4> version; bit<8> traffic_class; bit<20> flow_label;
    bit<16> payload_length; bit<8> next_header; bit<8> hop_limit;
    address_t source; address_t destination;
}
header extension_t { bit<8> next_header; bit<8> length; bit<48> first; } // RFC 8200, 4.2: 8 bytes, then
header extension_rest_t { varbit<16320> rest; }                          // `length` times 8 more
header fragment_t { bit<8> next_header; bit<8> reserved; bit<13> offset; bit<2> zero; bit<1> more; bit<32> identification; }
header tcp_t {
    bit<16> source_port; bit<16> destination_port; bit<32> sequence; bit<32> acknowledgement;
    bit<4> data_offset; bit<4> reserved; bit<8> flags; bit<16> window; bit<16> checksum; bit<16> urgent;
}
header udp_t { bit<16> source_port; bit<16> destination_port; bit<16> length; bit<16> checksum; }
header icmp_t { bit<8> type; bit<8> code; bit<16> checksum; bit<32> rest; }
header ports_t { bit<16> source_port; bit<16> destination_port; }        // quoted by an ICMP error

struct headers_t {
    packet_in_t packet_in;
    packet_out_t packet_out;
    ethernet_t ethernet;
    vlan_t[2] vlan;
    arp_t arp;
    ipv4_t ipv4;
    ipv4_options_t ipv4_options;
    ipv6_t ipv6;
    extension_t extension0;
    extension_rest_t extension0_rest;
    extension_t extension1;
    extension_rest_t extension1_rest;
    extension_t extension2;
    extension_rest_t extension2_rest;
    fragment_t fragment;
    tcp_t tcp;
    udp_t udp;
    icmp_t icmp;
    ipv4_t quoted_ipv4;
    ipv4_options_t quoted_ipv4_options;
    ipv6_t quoted_ipv6;
    ports_t quoted_ports;
}

// The ring of a difference out of which the frame takes a cell.
struct sweep_t {
    bit<32> size;                         // of the ring, 0 = none
    bit<32> ring;                         // where it begins
    bit<8> query;
    bit<32> threshold;
    bit<1> left;                          // more waits behind the one that was taken
}

struct metadata_t {
    // what a copy for the controller keeps (a plain clone would lose it)
    @field_list(COPY_FIELDS) bit<9> ingress_port;
    @field_list(COPY_FIELDS) bit<7> reason;
    @field_list(COPY_FIELDS) bit<48> timestamp;
    @field_list(COPY_FIELDS) bit<32> length;
    @field_list(COPY_FIELDS) bit<32> sequence;
    @field_list(COPY_FIELDS) bit<32> arrival;
    @field_list(COPY_FIELDS) query_map_t query_map;
    // what tables match on
    bit<12> vid;                          // outer VLAN, 0 = untagged
    bit<16> ethertype;                    // behind the VLAN tags
    bit<1> is_ipv4;                       // ARP counts as IPv4
    address_t source;
    address_t destination;
    bit<8> protocol;
    bit<2> fragment;                      // 0 whole, 1 first fragment, 2 later fragment
    bit<1> l4_valid;                      // ports (or ICMP type) below are those of the frame
    bit<16> source_port;
    bit<16> destination_port;
    bit<3> unparsed;
    bit<8> tcp_flags;
    bit<32> tcp_sequence;
    bit<32> tcp_acknowledgement;
    bit<1> quoted;                        // the ports are those that an ICMP error quotes
    bit<8> quoted_protocol;
    bit<8> icmp_type;
    bit<8> icmp_code;
    bit<16> arp_operation;
    mac_t arp_sender_mac;
    mac_t arp_target_mac;
    // verdicts
    bit<1> learns;                        // the controller shall hear of the sending station
    bit<1> blocked;
    bit<1> answered;                      // the switch itself answers (SYN cookie)
    query_map_t copies;                   // queries that want a packet-in
    query_map_t digests;                  // queries that want a digest of every frame
    query_map_t crossed;                  // counting queries whose threshold this frame reached
    query_map_t overflow;                 // counting queries that had no cell for this frame's key
    bit<1> reading;                       // the frame asks for cells and must not change counts
    bit<32> cell_epoch;                   // number of the window + 1
    bit<32> cell_slot;
    bit<384> cell;
    bit<32> cell_count;                   // before the frame
    sweep_t sweep;
}

struct frame_digest_t {
    query_map_t queries;                  // that the frame matched and that want digests
    query_map_t crossed;
    query_map_t overflow;
    bit<48> timestamp;
    bit<32> arrival;                      // also makes each digest unique: equal ones could be suppressed
    bit<32> sequence;
    bit<9> ingress_port;
    bit<12> vid;
    bit<16> ethertype;
    bit<32> length;
    mac_t eth_src;
    mac_t eth_dst;
    bit<1> is_ipv4;
    address_t src;
    address_t dst;
    bit<8> protocol;
    bit<2> fragment;
    bit<1> l4_valid;
    bit<1> quoted;                        // the ports below are those that an ICMP error quotes
    bit<8> quoted_protocol;
    bit<16> sport;
    bit<16> dport;
    bit<8> tcp_flags;
    bit<32> tcp_sequence;
    bit<32> tcp_acknowledgement;
    bit<8> icmp_type;
    bit<8> icmp_code;
    bit<16> arp_operation;
    mac_t arp_sender_mac;
    mac_t arp_target_mac;
}

// A station that sends and is not known, or from another port than it was known at.
struct learn_digest_t {
    mac_t mac;
    bit<9> port;
    bit<48> timestamp;
    bit<12> vid;
}

// A key whose difference is over its threshold at a window's end; the key as the cell holds it.
struct count_digest_t {
    bit<8> query;
    bit<32> window;                       // number
    bit<32> count;                        // two's complement
    address_t src;
    address_t dst;
    bit<16> port;
    bit<16> length;
    bit<16> source_port;
    bit<48> timestamp;                    // when it was found out
}
