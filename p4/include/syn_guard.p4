// The SYN guard: protects listed services from SYN floods in the packet path, without the controller.
//
//   SYN ─► known source within its rate? ─ yes ─────────────────────────────────────────────► pass
//            │ no
//          service protected? ─ no ─────────────────────────────────────────────────────────► pass
//            │ yes: the service's meter; its first non-green SYN starts a hold time
//          hold time running? ─ no ─────────────────────────────────────────────────────────► pass
//            │ yes
//          source proved by a cookie, or same SYN again after 0.2-8 s? ─ yes ─► last meter ─► pass
//            │ no                                                               yellow: cookies from
//          cookies asked for? ─ yes ─► answer SYN-ACK with a cookie, drop the SYN     now on, red: drop
//            │ no
//          remember the SYN, drop it (challenge 1: a real client sends it again)
//
// A client whose SYN is answered by a SYN-ACK with a foreign acknowledgement number sends a RST with
// that number (RFC 9293, 3.5.2): it proves that the source address is its own (challenge 2).

const bit<48> SYN_REPEAT_MIN_MS = 200;
const bit<48> SYN_REPEAT_MAX_MS = 8000;
const bit<48> PROVEN_MS = 60000;
const bit<48> COOKIE_LIFE_US = 10000000;
const bit<32> SYN_SLOTS = 1048576;
const bit<32> PROVEN_SLOTS = 65536;
const bit<32> SERVICES = 256;

// index of guard_outcomes
const bit<32> OUTCOME_KNOWN = 0;
const bit<32> OUTCOME_UNCHALLENGED = 1;
const bit<32> OUTCOME_CHALLENGED = 2;
const bit<32> OUTCOME_REPEATED = 3;
const bit<32> OUTCOME_PROVEN = 4;
const bit<32> OUTCOME_OVER_LAST_METER = 5;
const bit<32> OUTCOME_COOKIE_SENT = 6;
const bit<32> OUTCOME_COOKIE_CAPPED = 7;
const bit<32> OUTCOME_COOKIE_RETURNED = 8;
const bit<32> OUTCOME_SHORT_FRAGMENT = 9;

struct siphash_t { bit<32> v0; bit<32> v1; bit<32> v2; bit<32> v3; }

// HalfSipHash-2-4 (Aumasson, Bernstein) with a 32-bit result, over six words.
control HalfSipHash(in bit<32> k0, in bit<32> k1, in address_t source, in bit<32> folded_destination,
                    in bit<32> ports, out bit<32> tag) {
    siphash_t s;
    action two_rounds() {
#define SIPROUND \
        s.v0 = s.v0 + s.v1; s.v1 = (s.v1 << 5) | (s.v1 >> 27); s.v1 = s.v1 ^ s.v0; s.v0 = (s.v0 << 16) | (s.v0 >> 16); \
        s.v2 = s.v2 + s.v3; s.v3 = (s.v3 << 8) | (s.v3 >> 24); s.v3 = s.v3 ^ s.v2; \
        s.v0 = s.v0 + s.v3; s.v3 = (s.v3 << 7) | (s.v3 >> 25); s.v3 = s.v3 ^ s.v0; \
        s.v2 = s.v2 + s.v1; s.v1 = (s.v1 << 13) | (s.v1 >> 19); s.v1 = s.v1 ^ s.v2; s.v2 = (s.v2 << 16) | (s.v2 >> 16);
        SIPROUND
        SIPROUND
    }
#define SIPWORD(word) s.v3 = s.v3 ^ (word); two_rounds(); s.v0 = s.v0 ^ (word);
    apply {
        s.v0 = k0;
        s.v1 = k1;
        s.v2 = k0 ^ 0x6c796765;
        s.v3 = k1 ^ 0x74656463;
        SIPWORD(source[31:0])
        SIPWORD(source[63:32])
        SIPWORD(source[95:64])
        SIPWORD(source[127:96])
        SIPWORD(folded_destination)
        SIPWORD(ports)
        SIPWORD(32w0x18000000)
        s.v2 = s.v2 ^ 0xff;
        two_rounds();
        two_rounds();
        tag = s.v1 ^ s.v3;
    }
}

control SynGuard(inout headers_t hdr, inout metadata_t meta, inout standard_metadata_t standard) {
    @name(".ingress.known_sources_meter") direct_meter<bit<2>>(MeterType.packets) known_sources_meter;
    @name(".ingress.known_sources_counter") direct_counter(CounterType.packets) known_sources_counter;
    @name(".ingress.protect_meter") direct_meter<bit<2>>(MeterType.packets) protect_meter;
    @name(".ingress.protect_counter") direct_counter(CounterType.packets) protect_counter;
    @name(".ingress.guard_accept_meter") meter(SERVICES, MeterType.packets) accept_meter;
    @name(".ingress.guard_reflect_meter") meter(SERVICES, MeterType.packets) reflect_meter;
    @name(".ingress.guard_outcomes") counter(16, CounterType.packets) outcomes;

    @name(".ingress.guard_hold") register<bit<48>>(SERVICES) hold_until;
    @name(".ingress.guard_cookie_hold") register<bit<48>>(SERVICES) cookies_until;
    @name(".ingress.guard_cookie_sent") register<bit<48>>(1) last_cookie;
    // fingerprint (32 bits) and time in ms (32 bits) of SYNs, and of sources that returned a cookie
    @name(".ingress.guard_syns") register<bit<64>>(SYN_SLOTS) syn_records;
    @name(".ingress.guard_proven") register<bit<64>>(PROVEN_SLOTS) proven_sources;

    HalfSipHash() half_sip_hash;

    bit<2> color = METER_GREEN;
    bit<1> known = 0;
    bit<1> guarded = 0;
    bit<1> may_reflect = 0;
    bit<32> service = 0;
    bit<48> hold = 0;
    bit<48> until;
    bit<48> cookie_until;
    bit<32> now_ms = 0;
    bit<1> wants_cookie = 0;
    bit<1> returns_cookie = 0;
    bit<1> generation = 0;
    bit<32> key0 = 0;
    bit<32> key1 = 0;

    @name(".ingress.known") action known_source() {
        known_sources_meter.read(color);
        known_sources_counter.count();
        known = 1;
    }
    @name(".ingress.unknown") action unknown_source() { known_sources_counter.count(); }
    @name(".ingress.guard") action guard(bit<8> slot, bit<48> hold_us, bit<1> cookies) {
        protect_meter.read(color);
        protect_counter.count();
        guarded = 1;
        service = (bit<32>)slot;
        hold = hold_us;
        may_reflect = cookies;
    }
    @name(".ingress.unguarded") action unguarded() { protect_counter.count(); }
    @name(".ingress.drop_short_fragment") action drop_short_fragment() {
        meta.blocked = 1;
        outcomes.count(OUTCOME_SHORT_FRAGMENT);
    }
    @name(".ingress.set_secrets")
    action set_secrets(bit<1> current, bit<32> even_k0, bit<32> even_k1, bit<32> odd_k0, bit<32> odd_k1) {
        // a cookie's lowest bit says which secret made it, so that one may be replaced while the other lives
        generation = returns_cookie == 1 ? hdr.tcp.sequence[0:0] : current;
        key0 = generation == 1 ? odd_k0 : even_k0;
        key1 = generation == 1 ? odd_k1 : even_k1;
    }

    @name(".ingress.known_sources")
    @brief("Sources with completed handshakes, each with a meter, since addresses can be spoofed")
    table known_sources {
        key = {
            meta.is_ipv4: exact @name("is_ipv4");
            meta.source: exact @name("src");
        }
        actions = { known_source; @defaultonly unknown_source; }
        const default_action = unknown_source();
        meters = known_sources_meter;
        counters = known_sources_counter;
        support_timeout = true;
        size = 8192;
    }
    @name(".ingress.protect")
    @brief("Protected services; the meter is the rate of SYNs from unknown sources that needs no challenge")
    table protect {
        key = {
            meta.is_ipv4: exact @name("is_ipv4");
            meta.destination: exact @name("dst");
            meta.destination_port: exact @name("dport");
        }
        actions = { guard; @defaultonly unguarded; }
        const default_action = unguarded();
        meters = protect_meter;
        counters = protect_counter;
        size = 256;
    }
    @name(".ingress.protected_hosts")
    @brief("Hosts with protected services: first fragments without a whole TCP header are dropped")
    table protected_hosts {
        key = {
            meta.is_ipv4: exact @name("is_ipv4");
            meta.destination: exact @name("dst");
        }
        actions = { drop_short_fragment; NoAction; }
        default_action = NoAction();
        size = 256;
    }
    @name(".ingress.guard_secrets")
    @brief("Secrets of the SYN cookies: two, used in turn")
    table guard_secrets {
        key = { }
        actions = { set_secrets; }
        default_action = set_secrets(0, 0, 0, 0, 0);
    }

    // Turn the SYN into the SYN-ACK that asks its source for a RST.
    action reflect(bit<32> cookie) {
        mac_t mac = hdr.ethernet.source;
        hdr.ethernet.source = hdr.ethernet.destination;
        hdr.ethernet.destination = mac;
        bit<32> ipv4 = hdr.ipv4.source;
        hdr.ipv4.source = hdr.ipv4.destination;
        hdr.ipv4.destination = ipv4;
        hdr.ipv4.ttl = 64;
        hdr.ipv4.ihl = 5;
        hdr.ipv4.total_length = 40;
        hdr.ipv4_options.setInvalid();
        address_t ipv6 = hdr.ipv6.source;
        hdr.ipv6.source = hdr.ipv6.destination;
        hdr.ipv6.destination = ipv6;
        hdr.ipv6.hop_limit = 64;
        hdr.ipv6.payload_length = 20;
        bit<16> port = hdr.tcp.source_port;
        hdr.tcp.source_port = hdr.tcp.destination_port;
        hdr.tcp.destination_port = port;
        hdr.tcp.acknowledgement = cookie;
        hdr.tcp.sequence = 0;
        hdr.tcp.data_offset = 5;
        hdr.tcp.flags = 0x12;
        hdr.tcp.window = 0;
        hdr.tcp.urgent = 0;
        standard.egress_spec = meta.ingress_port;
        meta.answered = 1;
    }

    action remember_syn(bit<32> slot, bit<32> fingerprint) { syn_records.write(slot, fingerprint ++ now_ms); }

    apply {
        now_ms = (bit<32>)(meta.timestamp >> 10);
        if (meta.fragment == 1 && meta.protocol == PROTO_TCP && !hdr.tcp.isValid()) {
            protected_hosts.apply();
        } else if (hdr.tcp.isValid() && (hdr.tcp.flags & 0x17) == 0x02) {
            known_sources.apply();
            if (known == 1 && color == METER_GREEN) {
                outcomes.count(OUTCOME_KNOWN);
            } else {
                color = METER_GREEN;
                protect.apply();
            }
            if (guarded == 1) {
                hold_until.read(until, service);
                if (color != METER_GREEN) {
                    until = meta.timestamp + hold;
                    hold_until.write(service, until);
                }
                if (meta.timestamp >= until) {
                    outcomes.count(OUTCOME_UNCHALLENGED);
                } else {
                    bit<1> admitted = 0;
                    bit<32> slot;
                    bit<32> fingerprint;
                    bit<64> record;
                    hash(slot, HashAlgorithm.crc32, 32w0, { meta.source, 32w0x50524f56 }, PROVEN_SLOTS);
                    proven_sources.read(record, slot);
                    fingerprint = meta.source[31:0] ^ meta.source[63:32] ^ meta.source[95:64] ^ meta.source[127:96];
                    if (record[63:32] == fingerprint && (bit<48>)(now_ms - record[31:0]) < PROVEN_MS && record[31:0] != 0) {
                        admitted = 1;
                        outcomes.count(OUTCOME_PROVEN);
                    } else {
                        cookies_until.read(cookie_until, service);
                        if (may_reflect == 1 && meta.timestamp < cookie_until) {
                            wants_cookie = 1;
                        } else {
                            hash(slot, HashAlgorithm.crc32, 32w0,
                                 { meta.source, meta.destination, meta.source_port, meta.destination_port, hdr.tcp.sequence },
                                 SYN_SLOTS);
                            // another order of the fields: a second hash, not a shifted copy of the first
                            hash(fingerprint, HashAlgorithm.crc32, 32w0,
                                 { hdr.tcp.sequence, 16w0x5359, meta.source_port, meta.source, meta.destination_port, meta.destination },
                                 32w0xffffffff);
                            syn_records.read(record, slot);
                            bit<48> age = (bit<48>)(now_ms - record[31:0]);
                            if (record[63:32] == fingerprint && age >= SYN_REPEAT_MIN_MS && age <= SYN_REPEAT_MAX_MS) {
                                admitted = 1;
                                outcomes.count(OUTCOME_REPEATED);
                            } else {
                                meta.blocked = 1;
                                outcomes.count(OUTCOME_CHALLENGED);
                                // a SYN sent again too early must not put off its own time
                                if (record[63:32] != fingerprint || age > SYN_REPEAT_MAX_MS) {
                                    remember_syn(slot, fingerprint);
                                }
                            }
                        }
                    }
                    if (admitted == 1) {
                        accept_meter.execute_meter(service, color);
                        if (color != METER_GREEN) {
                            cookies_until.write(service, meta.timestamp + hold);
                        }
                        if (color == METER_RED) {
                            meta.blocked = 1;
                            outcomes.count(OUTCOME_OVER_LAST_METER);
                        }
                    }
                }
            }
        } else if (hdr.tcp.isValid() && (hdr.tcp.flags & 0x14) == 0x04) {
            last_cookie.read(until, 0);
            if (until != 0 && meta.timestamp - until < COOKIE_LIFE_US) {
                returns_cookie = 1;
            }
        }

        if (wants_cookie == 1 || returns_cookie == 1) {
            bit<32> cookie;
            guard_secrets.apply();
            bit<32> folded = meta.destination[31:0] ^ meta.destination[63:32] ^ meta.destination[95:64] ^ meta.destination[127:96];
            half_sip_hash.apply(key0, key1, meta.source, folded, meta.source_port ++ meta.destination_port, cookie);
            cookie = cookie[31:1] ++ generation;
            if (returns_cookie == 1) {
                if (hdr.tcp.sequence == cookie) {
                    bit<32> slot;
                    hash(slot, HashAlgorithm.crc32, 32w0, { meta.source, 32w0x50524f56 }, PROVEN_SLOTS);
                    proven_sources.write(slot, (meta.source[31:0] ^ meta.source[63:32] ^ meta.source[95:64] ^ meta.source[127:96]) ++ now_ms);
                    meta.blocked = 1; // the server never saw this connection
                    outcomes.count(OUTCOME_COOKIE_RETURNED);
                }
            } else {
                reflect_meter.execute_meter(service, color);
                if (color != METER_GREEN || hdr.extension0.isValid() || hdr.fragment.isValid() || meta.fragment != 0) {
                    meta.blocked = 1;
                    outcomes.count(OUTCOME_COOKIE_CAPPED);
                } else {
                    last_cookie.write(0, meta.timestamp);
                    outcomes.count(OUTCOME_COOKIE_SENT);
                    reflect(cookie);
                }
            }
        }
    }
}

// Checksums are computed only for frames that the switch makes.
control FrameChecksum(inout headers_t hdr, inout metadata_t meta) {
    apply {
        update_checksum(meta.answered == 1 && hdr.ipv4.isValid(),
            { hdr.ipv4.version, hdr.ipv4.ihl, hdr.ipv4.tos, hdr.ipv4.total_length, hdr.ipv4.identification, hdr.ipv4.flags,
              hdr.ipv4.fragment_offset, hdr.ipv4.ttl, hdr.ipv4.protocol, hdr.ipv4.source, hdr.ipv4.destination },
            hdr.ipv4.checksum, HashAlgorithm.csum16);
        update_checksum(meta.answered == 1 && hdr.ipv4.isValid(),
            { hdr.ipv4.source, hdr.ipv4.destination, 8w0, hdr.ipv4.protocol, 16w20,
              hdr.tcp.source_port, hdr.tcp.destination_port, hdr.tcp.sequence, hdr.tcp.acknowledgement,
              hdr.tcp.data_offset, hdr.tcp.reserved, hdr.tcp.flags, hdr.tcp.window, hdr.tcp.urgent },
            hdr.tcp.checksum, HashAlgorithm.csum16);
        update_checksum(meta.answered == 1 && hdr.ipv6.isValid(),
            { hdr.ipv6.source, hdr.ipv6.destination, 32w20, 24w0, 8w6,
              hdr.tcp.source_port, hdr.tcp.destination_port, hdr.tcp.sequence, hdr.tcp.acknowledgement,
              hdr.tcp.data_offset, hdr.tcp.reserved, hdr.tcp.flags, hdr.tcp.window, hdr.tcp.urgent },
            hdr.tcp.checksum, HashAlgorithm.csum16);
    }
}
