"""What queries say against senders and for victims: results weighed against what training saw.  Pure."""
