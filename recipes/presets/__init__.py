"""The paper's runs and others as data."""
