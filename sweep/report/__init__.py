"""The report of a store: figures, tables, page and example scenes; and tables of tradeoffs."""
