"""Linear models from Gram matrices alone: nothing here reads a row of the logs."""
