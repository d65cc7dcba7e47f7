"""What the pipeline archives that holds until further notice, and that its apps read when they start again.

Measurements make way at the disk quota; these do not, or a restart would forget blocks, the allow-list, or what an
operator called a false alarm.
"""

from typing import Final

from apps.evidence import TRAINING
from apps.firewall.evidence.history import ANSWERS, DECISIONS, INSTRUCTIONS, LESSONS
from apps.incidents import INCIDENTS

LASTING_KEYS: Final = (
    *DECISIONS,
    INSTRUCTIONS,
    f"{ANSWERS}.*",
    LESSONS,
    INCIDENTS,
    f"{TRAINING}.*",
    "network.p4_command.*.*",
)
"""The Coordinator's setting `lasting_keys`."""
