"""The report: one page that lays our figures beside the paper's, and says where they differ."""
