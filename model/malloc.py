"""Owns one setting of the C library's allocator that makes CPU training 1.3 to 4 times faster."""

import ctypes

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4


def keep_freed_memory() -> None:
    """Tells glibc to keep freed blocks for the next step; does nothing where there is no glibc.

    By default glibc returns every large tensor to the kernel when it is freed, and the next step pays a page fault for
    each 4 KiB again (measured: Linear 2.6 times, LeakyReLU 4.2 times slower).
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
        mallopt(M_TOP_PAD, 256 << 20)
