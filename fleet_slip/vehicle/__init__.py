"""The simulated car: parameters, tyre, equations of motion, driver, highway-env class and batch kernel."""
