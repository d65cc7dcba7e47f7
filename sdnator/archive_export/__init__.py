"""Archived columns as Parquet files, for Spark and other programs.

archive ─► items of an hour ─► rows with key, time and place in the archive ─► files by hour of event time
           (read in pieces)    (`item_rows`)                                   (`hour_files`)
                                                          and into the folder at once (`export_folder`)
"""
