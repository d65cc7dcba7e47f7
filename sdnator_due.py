"""The API as the paper writes it: `from sdnator_due import *`, and `due` is a ready engine.

from sdnator_due import *
due.init("MyNewAppId", PRODUCER | CONSUMER)
due.write(key, value, [PUB_ONLY])
due.observe(key).subscribe(lambda data: print(data.value))
"""

from due import CONSUMER, DB_ONLY, NO_WAIT, PRODUCER, PUB_ONLY, Capability, Engine, Interest

due = Engine()

__all__ = ["CONSUMER", "DB_ONLY", "NO_WAIT", "PRODUCER", "PUB_ONLY", "Capability", "Interest", "due"]
