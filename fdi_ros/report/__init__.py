"""The kit of all pages and tables: sections, plots, long series, text tables, units."""
