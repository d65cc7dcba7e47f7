"""The costs that the product brings, as `sdnator plan --measure` writes them, and where and when they were measured.

Any machine's own are better: `sdnator plan --measure`.
"""

from sdnator.plan.costs import Costs, decoded

TEXT = """\
{
 "machine": "AMD EPYC (virtual machine)",
 "cores": 2,
 "measured": "2026-11-25",
 "note": "4,000 packets a second: 25 minutes of a soak run; 100 and 400: seconds at idle priority beside it, so too high",
 "rates": [100.0, 400.0, 4000.0],
 "processes": {
  "coordinator": {"idle_cores": 0.012, "mib": 47},
  "dashboard": {"idle_cores": 0.037, "mib": 89, "switch_mib": 2.3},
  "firewall": {"idle_cores": 0.0074, "us_per_packet": [13.3, 20.6, 14.5], "mib": 97},
  "kitsune": {"idle_cores": 0.0025, "us_per_packet": [788.0, 186.0, 30.7], "mib": 285},
  "p4runtime_ctrl": {
   "idle_cores": 0.0074, "switch_cores": 0.0025, "us_per_packet": [713.0, 221.0, 41.6], "mib": 80, "switch_mib": 1.7
  },
  "sonata_adapter": {
   "idle_cores": 0.0025, "switch_cores": 0.0013, "us_per_packet": [113.0, 61.0, 26.0], "us_per_query": 15.3,
   "mib": 105, "switch_mib": 16
  },
  "spare": {"per_switch": true, "mib": 46},
  "supervisor": {"idle_cores": 0.0024, "mib": 58},
  "switch": {"per_switch": true, "idle_cores": 0.0025, "us_per_packet": [488.0, 124.0, 37.5], "mib": 64},
  "updates": {"idle_cores": 0.0049, "us_per_packet": [126.0, 47.0, 14.1], "mib": 51}
 },
 "updates_in": [1889.0, 907.0, 595.0],
 "updates_out": [1157.0, 585.0, 474.0],
 "archive": [983.0, 563.0, 472.0],
 "query_updates_in": 60.0,
 "query_updates_out": 40.0,
 "query_archive": 30.0,
 "consumer_updates_out": 100.0,
 "sqlite_bytes_per_s": 52000000.0,
 "keys": 33,
 "switch_keys": 7,
 "topics": [35, 4]
}
"""


def default_costs() -> Costs:
    """Read from the text."""
    return decoded(TEXT, "the product's costs")
