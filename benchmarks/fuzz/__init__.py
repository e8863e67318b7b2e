"""Hostile and broken input, made by mutation: whatever comes, the answer is data or our own error.

python -m benchmarks.fuzz --cases 20000      every target in turn, in processes with limits
"""
