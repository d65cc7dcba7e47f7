"""Incidents: evidence, alerts and decisions about one attacker or one victim, as one thing."""
