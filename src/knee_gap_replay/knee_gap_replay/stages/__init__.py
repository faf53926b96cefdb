"""The second stage of the pipeline; the first is in `pipeline.py`."""
