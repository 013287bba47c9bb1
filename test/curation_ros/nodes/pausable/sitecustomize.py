"""Python runs this first in a node that was started in `pausing.pausable`."""

import signal

# Later threads inherit the mask. Then only sigwait takes the signal, however early it comes.
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR2])
signal.signal(signal.SIGUSR1, lambda *_: signal.sigwait([signal.SIGUSR2]))
