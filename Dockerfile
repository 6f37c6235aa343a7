# The CPU renderer and everything else in one image:
#   docker build -t gnmreg .
#   docker run --rm -u "$(id -u)" -v "$PWD:/data" gnmreg register CAPTURE --model MODEL --out OUT
# With PyTorch's CUDA build, for --variant cuda (the host needs the NVIDIA Container Toolkit):
#   docker build -t gnmreg:cuda --build-arg TORCH_INDEX=https://pypi.org/simple .
#   docker run --rm --gpus all -u "$(id -u)" -v "$PWD:/data" gnmreg:cuda register ... --variant cuda
#
# Debian 13, as the tag 13-slim was on 2026-08-24. A newer one:
#   docker buildx imagetools inspect debian:13-slim
ARG DEBIAN=debian:13-slim@sha256:d7e12182ce18b85b93007c1dedf31f2d29e01ccf3182cc4017c709b6259bc132

FROM ${DEBIAN} AS base
RUN apt-get update \
 && apt-get install -y --no-install-recommends ca-certificates python3 libllvm19 libatomic1 \
 && rm -rf /var/lib/apt/lists/*

# Dependencies first: a change of the source does not install them again. Neither development tools nor the optional
# packages that contain GPL code.
FROM base AS build
RUN apt-get update && apt-get install -y --no-install-recommends python3-venv
WORKDIR /build
COPY pyproject.toml constraints.txt ./
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ENV PIP_NO_CACHE_DIR=1 PIP_CONSTRAINT=/build/constraints.txt PIP_ONLY_BINARY=:all:
RUN python3 -m venv /opt/gnmreg \
 && /opt/gnmreg/bin/pip install pip setuptools \
 && /opt/gnmreg/bin/pip install --index-url "$TORCH_INDEX" --extra-index-url https://pypi.org/simple torch \
 && /opt/gnmreg/bin/python -c 'import tomllib; project = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
print(*project["dependencies"], *project["optional-dependencies"]["s3"], sep="\n")' > requirements.txt \
 && /opt/gnmreg/bin/pip install --requirement requirements.txt
COPY LICENSE NOTICE README.md ./
COPY registration registration
COPY coregister coregister
COPY workflows workflows
RUN /opt/gnmreg/bin/pip install --no-deps --no-build-isolation .

FROM base
# Any user may run the image: caches (compiled kernels, model weights) go to a home that all can write.
RUN useradd --uid 10001 --create-home gnmreg
COPY --from=build /opt/gnmreg /opt/gnmreg
ENV HOME=/home/gnmreg PATH=/opt/gnmreg/bin:$PATH PYTHONDONTWRITEBYTECODE=1 \
    NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,graphics,utility
USER gnmreg
RUN python -m registration.render.llvm && chmod -R a+rwX "$HOME"
WORKDIR /data
ENTRYPOINT ["gnmreg"]
