"""Reading and writing of files. The only layer, with `data`, whose functions take paths."""
