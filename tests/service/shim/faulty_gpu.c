// A Vulkan driver that passes all calls to another one, named in FAULTY_GPU_DRIVER, with faults on request:
//
// FAULTY_GPU_LOSS   names a file. If it exists at a submission of work, it is deleted, and the device is lost from then on,
//                   as after a reset of a card.
// FAULTY_GPU_FULL   names a file. If it exists at an allocation, it is deleted, and the allocation fails for lack of memory.
// FAULTY_GPU_MEMORY names a file with a number. Larger allocations in bytes fail for lack of memory.

#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

// Results of Vulkan.
#define OUT_OF_DEVICE_MEMORY (-2)
#define DEVICE_LOST (-4)

typedef void (*function)(void);
typedef function (*lookup)(void *object, const char *name);

// VkMemoryAllocateInfo.
struct allocation {
    int32_t type;
    const void *next;
    uint64_t size;
    uint32_t memory_type;
};

static lookup device_function;
static int32_t (*submit)(void *queue, uint32_t count, const void *submits, void *fence);
static int32_t (*allocate)(void *device, const struct allocation *info, const void *callbacks, void *memory);
static volatile int is_lost;

static void *driver(const char *name)
{
    static void *library;
    if (!library)
        library = dlopen(getenv("FAULTY_GPU_DRIVER"), RTLD_NOW | RTLD_LOCAL);
    return library ? dlsym(library, name) : NULL;
}

static int32_t faulty_submit(void *queue, uint32_t count, const void *submits, void *fence)
{
    const char *file = getenv("FAULTY_GPU_LOSS");
    if (file && unlink(file) == 0)
        is_lost = 1;
    return is_lost ? DEVICE_LOST : submit(queue, count, submits, fence);
}

static int32_t faulty_allocate(void *device, const struct allocation *info, const void *callbacks, void *memory)
{
    const char *full = getenv("FAULTY_GPU_FULL");
    if (full && unlink(full) == 0)
        return OUT_OF_DEVICE_MEMORY;
    unsigned long long most;
    const char *name = getenv("FAULTY_GPU_MEMORY");
    FILE *file = name ? fopen(name, "r") : NULL;
    if (file) {
        int count = fscanf(file, "%llu", &most);
        fclose(file);
        if (count == 1 && info->size > most)
            return OUT_OF_DEVICE_MEMORY;
    }
    return allocate(device, info, callbacks, memory);
}

static function replaced(const char *name, function original)
{
    if (original && strcmp(name, "vkQueueSubmit") == 0) {
        submit = (void *)original;
        return (function)faulty_submit;
    }
    if (original && strcmp(name, "vkAllocateMemory") == 0) {
        allocate = (void *)original;
        return (function)faulty_allocate;
    }
    return original;
}

static function faulty_device_function(void *device, const char *name)
{
    return replaced(name, device_function(device, name));
}

function vk_icdGetInstanceProcAddr(void *instance, const char *name)
{
    function original = ((lookup)driver("vk_icdGetInstanceProcAddr"))(instance, name);
    if (original && strcmp(name, "vkGetDeviceProcAddr") == 0) {
        device_function = (lookup)original;
        return (function)faulty_device_function;
    }
    return replaced(name, original);
}

function vk_icdGetPhysicalDeviceProcAddr(void *instance, const char *name)
{
    lookup original = (lookup)driver("vk_icdGetPhysicalDeviceProcAddr");
    return original ? original(instance, name) : NULL;
}

int32_t vk_icdNegotiateLoaderICDInterfaceVersion(uint32_t *version)
{
    int32_t (*negotiate)(uint32_t *) = driver("vk_icdNegotiateLoaderICDInterfaceVersion");
    return negotiate(version);
}
