"""What every page shares: its look, its drawings, its tables and its templates."""
