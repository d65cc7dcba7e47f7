"""Enforcers beside the switches, each an app of its own, and what they share.

decisions ──► EnforcementWorker (one worker thread) ──► Enforcer: nftables, a webhook, …
                   │  DesiredBlocks: what shall stand, and until when (pure)
                   └─► confirmations, reports
"""
