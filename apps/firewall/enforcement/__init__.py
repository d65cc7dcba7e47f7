"""Output of decisions: table entries, EVE, webhooks."""
