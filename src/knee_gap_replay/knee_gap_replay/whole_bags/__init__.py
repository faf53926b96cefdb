"""Commands on whole bags: what may be replaced, recovery, many bags at once."""
