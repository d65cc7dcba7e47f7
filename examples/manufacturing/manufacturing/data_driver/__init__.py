"""Data Driver: assignments become REST calls, printers' data becomes DUE data; it knows no scheduling."""
