"""A stand-alone analyser beside the loop: which senders does Kitsune find worst?"""
# ruff: noqa: F403, F405 - the way of importing that the paper shows

# [analyser]
from collections import Counter

from sdnator_due import *

worst: Counter[str] = Counter()
due.init("WorstSenders", CONSUMER)
due.observe("network.anomaly.kitsune.alert").subscribe(
    lambda alert: worst.update([alert.value["sender"]["ip"]])
)
input("Enter to see the result\n")
print(worst.most_common(10))
# [/analyser]
