"""Enforcers beside the switches, each an app of its own, and what they share.

decisions ──► EnforcerDesk (one worker thread) ──► Enforcer: nftables, a webhook, …
                   │  WishList: what shall stand, and until when (pure)
                   └─► confirmations, reports
"""
