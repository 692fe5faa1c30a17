"""Programs that test campaigns with untrusted files and system faults: minutes within the tests, hours on their own."""
