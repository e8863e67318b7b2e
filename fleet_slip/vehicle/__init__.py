"""The simulated car: parameters, equations of motion, driver, highway-env class, batch kernel."""
