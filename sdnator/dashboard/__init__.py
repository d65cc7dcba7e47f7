"""The dashboard: a DUE app that serves a page.

scores, alerts, decisions, states ──► Board (bounded, pure) ──► pages (NiceGUI) ──► browsers
Coordinator's HTTP API ─────────────►   │
network.instruction.dashboard.firewall ◄┘  undo and allow, from those who have signed in
"""
