"""Commands that read or write bags: play, record, process, check, evaluate, import_motive."""
