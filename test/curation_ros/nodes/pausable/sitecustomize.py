"""Python runs this first in a node that `pausing.pausable` has started: see there."""

import signal

# Threads that come later inherit it: only sigwait takes the signal then, however early it comes.
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR2])
signal.signal(signal.SIGUSR1, lambda *_: signal.sigwait([signal.SIGUSR2]))
