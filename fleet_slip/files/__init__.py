"""Where a data root's files are: a local folder or an object store, behind one small protocol."""
