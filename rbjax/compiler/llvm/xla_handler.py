"""Prints a program over a batch as a handler that XLA calls from a compiled program.

The handler is a function of XLA's typed foreign function interface (`xla/ffi/api/c_api.h`). It
reads the buffers from the call frame and computes the parts of the batch. One part is computed on
the calling thread; several are also computed on the threads of XLA's pool. Each thread computes the
next part until all are started. Then the caller waits for the parts in progress.
"""

from __future__ import annotations

from rbjax.compiler.ir.program import Written
from rbjax.compiler.llvm.batch import write_parts
from rbjax.compiler.llvm.jit import Module

# byte offsets of members of the structs of c_api.h
EXTENSION, API, CONTEXT, STAGE, ARGS, RESULTS = 8, 16, 24, 32, 72, 112  # XLA_FFI_CallFrame
EXTENSION_TYPE, EXTENSION_NEXT, METADATA = 8, 16, 24  # XLA_FFI_Metadata_Extension
VERSION, TRAITS = 24, 32  # XLA_FFI_Metadata and its api_version
#: the version of c_api.h with these members; XLA rejects handlers of versions it no longer supports
MAJOR, MINOR = 0, 3
DATA = 24  # XLA_FFI_Buffer
ERROR, SCHEDULE, THREADS = 48, 136, 144  # XLA_FFI_Api
METADATA_QUERY, EXECUTE, EXHAUSTED = 1, 3, 8  # values of its enumerations

#: offsets in the state that threads share: next part, parts done, failures, owners, buffers
NEXT, DONE, FAILED, OWNERS, BUFFERS = 0, 8, 16, 24, 32

METADATA_ANSWER = f"""
define internal ptr @describe(ptr %frame, ptr %extension) nounwind {{
  %w = getelementptr i8, ptr %extension, i64 {EXTENSION_TYPE}
  %what = load i32, ptr %w
  %asked = icmp eq i32 %what, {METADATA_QUERY}
  br i1 %asked, label %answer, label %end
answer:
  %m = getelementptr i8, ptr %extension, i64 {METADATA}
  %metadata = load ptr, ptr %m
  %v = getelementptr i8, ptr %metadata, i64 {VERSION}
  store i64 {MINOR << 32 | MAJOR}, ptr %v, align 4
  %t = getelementptr i8, ptr %metadata, i64 {TRAITS}
  store i32 0, ptr %t
  br label %end
end:
  ret ptr null
}}
@message = internal constant [34 x i8] c"rbjax: no memory for local arrays\\00"
define internal ptr @failure(ptr %frame) nounwind {{
  %a = getelementptr i8, ptr %frame, i64 {API}
  %api = load ptr, ptr %a
  %c = getelementptr i8, ptr %api, i64 {ERROR}
  %create = load ptr, ptr %c
  %args = alloca {{i64, ptr, ptr, i32}}
  store {{i64, ptr, ptr, i32}} {{i64 28, ptr null, ptr @message, i32 {EXHAUSTED}}}, ptr %args
  %error = call ptr %create(ptr %args)
  ret ptr %error
}}
"""

SHARING = f"""
declare i32 @sched_yield()
define internal void @release(ptr %state) nounwind {{
  %o = getelementptr i8, ptr %state, i64 {OWNERS}
  %before = atomicrmw sub ptr %o, i64 1 acq_rel
  %last = icmp eq i64 %before, 1
  br i1 %last, label %free, label %end
free:
  call void @free(ptr %state)
  br label %end
end:
  ret void
}}
define internal void @work(ptr %state) nounwind {{
  %n = getelementptr i8, ptr %state, i64 {NEXT}
  %d = getelementptr i8, ptr %state, i64 {DONE}
  %f = getelementptr i8, ptr %state, i64 {FAILED}
  %buffers = getelementptr i8, ptr %state, i64 {BUFFERS}
  br label %take
take:
  %index = atomicrmw add ptr %n, i64 1 monotonic
  %some = icmp slt i64 %index, COUNT
  br i1 %some, label %compute, label %end
compute:
  %bad = call i32 @part(ptr %buffers, i64 %index)
  %wide = zext i32 %bad to i64
  %failures = atomicrmw add ptr %f, i64 %wide monotonic
  %before = atomicrmw add ptr %d, i64 1 release
  br label %take
end:
  ret void
}}
define internal void @task(ptr %state) nounwind {{
  call void @work(ptr %state)
  call void @release(ptr %state)
  ret void
}}
define internal i64 @invite(ptr %frame, ptr %state) nounwind {{
entry:
  %a = getelementptr i8, ptr %frame, i64 {API}
  %api = load ptr, ptr %a
  %c = getelementptr i8, ptr %frame, i64 {CONTEXT}
  %context = load ptr, ptr %c
  %t = getelementptr i8, ptr %api, i64 {THREADS}
  %threads = load ptr, ptr %t
  %s = getelementptr i8, ptr %api, i64 {SCHEDULE}
  %schedule = load ptr, ptr %s
  %count = alloca i64
  store i64 1, ptr %count
  %ask = alloca {{i64, ptr, ptr, ptr}}
  store {{i64, ptr, ptr, ptr}} {{i64 32, ptr null, ptr null, ptr null}}, ptr %ask
  %ask2 = getelementptr i8, ptr %ask, i64 16
  store ptr %context, ptr %ask2
  %ask3 = getelementptr i8, ptr %ask, i64 24
  store ptr %count, ptr %ask3
  %e = call ptr %threads(ptr %ask)
  call void @forget(ptr %api, ptr %e)
  %found = load i64, ptr %count
  %most = call i64 @llvm.smin.i64(i64 %found, i64 COUNT)
  %args = alloca {{i64, ptr, ptr, ptr, ptr}}
  store {{i64, ptr, ptr, ptr, ptr}} {{i64 40, ptr null, ptr null, ptr @task, ptr null}}, ptr %args
  %args2 = getelementptr i8, ptr %args, i64 16
  store ptr %context, ptr %args2
  %args4 = getelementptr i8, ptr %args, i64 32
  store ptr %state, ptr %args4
  %o = getelementptr i8, ptr %state, i64 {OWNERS}
  br label %next
next:
  %k = phi i64 [1, %entry], [%more, %again]
  %enough = icmp sge i64 %k, %most
  br i1 %enough, label %end, label %again0
again0:
  %owners = atomicrmw add ptr %o, i64 1 monotonic
  %refused = call ptr %schedule(ptr %args)
  %fine = icmp eq ptr %refused, null
  br i1 %fine, label %again, label %stop
again:
  %more = add i64 %k, 1
  br label %next
stop:
  call void @forget(ptr %api, ptr %refused)
  call void @release(ptr %state)
  br label %end
end:
  ret i64 %k
}}
define internal void @forget(ptr %api, ptr %error) nounwind {{
  %none = icmp eq ptr %error, null
  br i1 %none, label %end, label %destroy
destroy:
  %d = getelementptr i8, ptr %api, i64 {ERROR + 16}
  %function = load ptr, ptr %d
  %args = alloca {{i64, ptr, ptr}}
  store {{i64, ptr, ptr}} {{i64 24, ptr null, ptr null}}, ptr %args
  %a = getelementptr i8, ptr %args, i64 16
  store ptr %error, ptr %a
  call void %function(ptr %args)
  br label %end
end:
  ret void
}}
define internal i32 @all(ptr %frame, ptr %buffers) nounwind {{
entry:
  %state = call ptr @malloc(i64 STATE)
  %nothing = icmp eq ptr %state, null
  br i1 %nothing, label %full, label %begin
full:
  ret i32 1
begin:
  call void @llvm.memset.p0.i64(ptr %state, i8 0, i64 {BUFFERS}, i1 false)
  %o = getelementptr i8, ptr %state, i64 {OWNERS}
  store i64 1, ptr %o
  %b = getelementptr i8, ptr %state, i64 {BUFFERS}
  call void @llvm.memcpy.p0.p0.i64(ptr %b, ptr %buffers, i64 BYTES, i1 false)
  %invited = call i64 @invite(ptr %frame, ptr %state)
  call void @work(ptr %state)
  %d = getelementptr i8, ptr %state, i64 {DONE}
  br label %look
look:
  %done = load atomic i64, ptr %d acquire, align 8
  %ready = icmp eq i64 %done, COUNT
  br i1 %ready, label %end, label %wait
wait:
  %y = call i32 @sched_yield()
  br label %look
end:
  %f = getelementptr i8, ptr %state, i64 {FAILED}
  %failures = load i64, ptr %f
  call void @release(ptr %state)
  %failed = icmp ne i64 %failures, 0
  %out = zext i1 %failed to i32
  ret i32 %out
}}
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)
"""


def write_handler(program: Written, samples: int | None = None) -> tuple[Module, int]:
    """Return the module of the handler `run`, and the number of parts of the batch.

    Each summed result has one row per part. samples: number of samples of a part; None to choose it
    by the work of a sample.
    """
    made = write_parts(program, samples=samples)
    n = len(program.operands)
    names = [*((ARGS, k) for k in range(n)), *((RESULTS, k) for k in range(len(program.results)))]
    lines = ["%list = alloca [" + str(max(len(names), 1)) + " x ptr]"]
    for where in (ARGS, RESULTS):
        lines += [f"%p{where} = getelementptr i8, ptr %frame, i64 {where}",
                  f"%l{where} = load ptr, ptr %p{where}"]  # fmt: skip
    for k, (where, i) in enumerate(names):
        lines += [
            f"%a{k} = getelementptr ptr, ptr %l{where}, i64 {i}", f"%b{k} = load ptr, ptr %a{k}",
            f"%c{k} = getelementptr i8, ptr %b{k}, i64 {DATA}", f"%d{k} = load ptr, ptr %c{k}",
            f"%e{k} = getelementptr ptr, ptr %list, i64 {k}", f"store ptr %d{k}, ptr %e{k}",
        ]  # fmt: skip
    run = "@part(ptr %list, i64 0)" if made.count == 1 else "@all(ptr %frame, ptr %list)"
    shared = ""
    if made.count > 1:
        shared = SHARING.replace("COUNT", str(made.count)).replace("BYTES", str(8 * len(names)))
        shared = shared.replace("STATE", str(BUFFERS + 8 * len(names)))
    text = [
        made.text, METADATA_ANSWER, shared,
        "define ptr @run(ptr %frame) nounwind {",
        f"%x = getelementptr i8, ptr %frame, i64 {EXTENSION}", "%extension = load ptr, ptr %x",
        "%plain = icmp eq ptr %extension, null",
        "br i1 %plain, label %stages, label %asked",
        "asked:", "%answer = call ptr @describe(ptr %frame, ptr %extension)", "ret ptr %answer",
        "stages:", f"%s = getelementptr i8, ptr %frame, i64 {STAGE}", "%stage = load i32, ptr %s",
        f"%now = icmp eq i32 %stage, {EXECUTE}", "br i1 %now, label %execute, label %other",
        "other:", "ret ptr null", "execute:", *lines, f"%bad = call i32 {run}",
        "%good = icmp eq i32 %bad, 0", "br i1 %good, label %other, label %full",
        "full:", "%error = call ptr @failure(ptr %frame)", "ret ptr %error", "}",
    ]  # fmt: skip
    symbols = (*made.libm, *(("sched_yield",) if shared else ()))
    return Module("\n".join(text), symbols), made.count
