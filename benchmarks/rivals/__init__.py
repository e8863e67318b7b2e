"""The paper's rivals and others, which no car and no night needs."""
