"""The costs that the product brings, as `sdnator plan --measure` writes them, and where and when they were measured.

Any machine's own are better: `sdnator plan --measure`.
"""

from sdnator.plan.costs import Costs, decoded

TEXT = """\
{
 "machine": "AMD EPYC (virtual machine)",
 "cores": 2,
 "measured": "2026-11-26",
 "note": "memory: after two hours of a soak run with full tables",
 "rates": [100.0, 1000.0, 4000.0],
 "processes": {
  "coordinator": {"idle_cores": 0.011, "switch_cores": 0.0002, "us_per_packet": [24.9, 1.34, 0.31], "mib": 47},
  "dashboard": {"idle_cores": 0.0068, "us_per_packet": [286.0, 29.0, 8.13], "us_per_query": 1.5, "mib": 82},
  "firewall": {
   "idle_cores": 0.0049, "switch_cores": 0.00081, "us_per_packet": [146.0, 22.7, 8.16],
   "us_per_query": 0.88, "mib": 108
  },
  "kitsune": {
   "idle_cores": 0.0039, "us_per_packet": [869.0, 94.0, 28.9], "us_per_query": 4.6,
   "us_per_consumer": 3.4, "mib": 523
  },
  "p4runtime_ctrl": {
   "idle_cores": 0.0088, "switch_cores": 0.0021, "us_per_packet": [816.0, 107.0, 34.8],
   "us_per_query": 8.9, "us_per_consumer": 2.2, "mib": 79, "switch_mib": 3.7
  },
  "sonata_adapter": {
   "idle_cores": 0.0049, "us_per_packet": [70.0, 40.5, 17.7], "us_per_query": 7.3,
   "us_per_consumer": 1.5, "mib": 75
  },
  "spare": {"per_switch": true, "mib": 57},
  "supervisor": {"idle_cores": 0.0019, "switch_cores": 0.00041, "us_per_packet": [0.0, 0.669, 0.215], "mib": 54},
  "switch": {
   "per_switch": true, "idle_cores": 0.0019, "us_per_packet": [558.0, 60.5, 20.0], "us_per_query": 2.8,
   "us_per_consumer": 1.1, "mib": 67
  },
  "updates": {
   "idle_cores": 0.0039, "switch_cores": 0.00037, "us_per_packet": [290.0, 33.1, 9.93], "us_per_query": 1.8,
   "us_per_consumer": 4.7, "mib": 59
  }
 },
 "updates_in": [2570.0, 678.0, 359.0],
 "updates_out": [1420.0, 438.0, 281.0],
 "archive": [1220.0, 463.0, 301.0],
 "query_updates_in": 10.3,
 "query_updates_out": 4.79,
 "query_archive": 2.25,
 "consumer_updates_out": 72.8,
 "archive_idle": 0.0,
 "sqlite_bytes_per_s": 240000000.0,
 "keys": 30,
 "switch_keys": 7,
 "topics": [35, 5]
}
"""


def default_costs() -> Costs:
    """Read from the text."""
    return decoded(TEXT, "the product's costs")
