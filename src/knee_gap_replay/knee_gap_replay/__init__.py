"""Everything that reads or writes bags: play, record, process, check."""
