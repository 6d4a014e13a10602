"""Bad input into every entry point: ``matches`` and ``files`` make it, ``promises`` says what must hold."""
