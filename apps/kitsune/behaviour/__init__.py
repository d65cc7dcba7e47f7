"""What senders do, beside how their packets look: contacts, attempts and floods, against what training saw."""
