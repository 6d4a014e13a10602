"""Bad input into every entry point: ``matches``, ``files``, ``databases`` make it, ``promises`` says what must hold."""
