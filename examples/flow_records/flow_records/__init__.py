"""Flow records on SDNator: what routers and switches that speak no P4 tell about their traffic.

    exporter ──UDP──► udp_listener ─► datagram_queue ─► decoding/ ─► network.flows.flow_records.<exporter>
                        (thread)        (bounded)        (pure)                   │
                                                                                  ▼
              network.traffic_query.flow_queries.<query> ◄─ Sonata's operators ◄─ packet_rows

Two apps: `flow_records` (`service.py`) collects, `flow_queries` (`flow_queries/service.py`) runs queries.
"""
