"""Prints the names of the Vulkan adapters, one a line; exit code 1 where there is none.

Uses the loader by ctypes, so that `scripts/setup` can check an adapter before anything is built.
"""

import ctypes
import sys

APPLICATION_INFO, INSTANCE_CREATE_INFO = 0, 1


class ApplicationInfo(ctypes.Structure):
    _fields_ = [("type", ctypes.c_int), ("next", ctypes.c_void_p), ("name", ctypes.c_char_p),
                ("version", ctypes.c_uint32), ("engine", ctypes.c_char_p),
                ("engine_version", ctypes.c_uint32), ("api_version", ctypes.c_uint32)]


class InstanceCreateInfo(ctypes.Structure):
    _fields_ = [("type", ctypes.c_int), ("next", ctypes.c_void_p), ("flags", ctypes.c_uint32),
                ("application", ctypes.POINTER(ApplicationInfo)),
                ("layer_count", ctypes.c_uint32), ("layers", ctypes.c_void_p),
                ("extension_count", ctypes.c_uint32), ("extensions", ctypes.c_void_p)]


def adapters() -> list[str]:
    """Names of all adapters; an OSError where the loader itself is missing."""
    vulkan = ctypes.CDLL("libvulkan.so.1")
    application = ApplicationInfo(type=APPLICATION_INFO, api_version=1 << 22 | 1 << 12)
    create = InstanceCreateInfo(type=INSTANCE_CREATE_INFO, application=ctypes.pointer(application))
    instance = ctypes.c_void_p()
    if vulkan.vkCreateInstance(ctypes.byref(create), None, ctypes.byref(instance)) != 0:
        return []
    count = ctypes.c_uint32()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    devices = (ctypes.c_void_p * count.value)()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), devices)
    names = []
    for device in devices:
        # VkPhysicalDeviceProperties is under 1 KiB; the name stands after five 32-bit numbers.
        properties = ctypes.create_string_buffer(4096)
        vulkan.vkGetPhysicalDeviceProperties(ctypes.c_void_p(device), properties)
        names.append(properties.raw[20:276].split(b"\0")[0].decode(errors="replace"))
    vulkan.vkDestroyInstance(instance, None)
    return names


if __name__ == "__main__":
    try:
        found = adapters()
    except OSError as error:
        sys.exit(f"no Vulkan loader: {error}")
    print("\n".join(found))
    sys.exit(0 if found else 1)
