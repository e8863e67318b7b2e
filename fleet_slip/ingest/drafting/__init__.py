"""What a stranger's log probably holds: a draft of its mapping, and what looks wrong in it."""
