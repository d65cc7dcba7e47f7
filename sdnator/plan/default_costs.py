"""The costs that the product brings, as `sdnator plan --measure` writes them, and where and when they were measured.

Any machine's own are better: `sdnator plan --measure`.
"""

from sdnator.plan.costs import Costs, decoded

TEXT = """\
{
 "machine": "AMD EPYC (virtual machine)",
 "cores": 2,
 "measured": "2026-11-25",
 "note": "from 25 minutes of a soak run at one rate, with a reader of scores, a query, and other work at idle priority",
 "rates": [4000.0],
 "processes": {
  "coordinator": {"us_per_packet": [3.0], "mib": 47},
  "dashboard": {"us_per_packet": [9.2], "mib": 89},
  "firewall": {"us_per_packet": [16.4], "mib": 97},
  "kitsune": {"us_per_packet": [31.3], "mib": 285},
  "p4runtime_ctrl": {"us_per_packet": [43.5], "mib": 80},
  "sonata_adapter": {"us_per_packet": [26.6], "mib": 105},
  "spare": {"per_switch": true, "mib": 46},
  "supervisor": {"us_per_packet": [0.6], "mib": 58},
  "switch": {"per_switch": true, "us_per_packet": [38.1], "mib": 64},
  "updates": {"us_per_packet": [15.3], "mib": 51}
 },
 "updates_in": [595.0],
 "updates_out": [474.0],
 "archive": [472.0]
}
"""


def default_costs() -> Costs:
    """Read from the text."""
    return decoded(TEXT, "the product's costs")
