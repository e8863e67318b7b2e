"""What a model must be before it becomes champion, and what its drives and course must be."""
