"""The app `flow_queries`: Sonata queries over flow records.

`query_windows.py` decides, `service.py` talks to DUE.
"""
