"""Parameters of cars and receivers, estimated from Gram rows: sensors, delay, course, intercept."""
