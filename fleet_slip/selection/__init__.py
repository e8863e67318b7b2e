"""Which model: comparison, search, uncertainty and diagnosis, all from Gram matrices."""
