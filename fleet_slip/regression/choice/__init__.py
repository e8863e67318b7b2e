"""Which inputs: nested models, subsets, orders and criteria."""
