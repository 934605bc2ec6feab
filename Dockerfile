# hrcreplay on the command line, for a machine without Python 3.11 to 3.14. Building it needs a network, running it does not:
#   docker build -t hrcreplay .                                       (podman build -t hrcreplay . likewise)
#   docker run --rm -v "$PWD:/data" --user "$(id -u):$(id -g)" hrcreplay report session.mcap --cell cell.toml
FROM python:3.13-slim AS wheel
WORKDIR /source
COPY . .
RUN pip install --no-cache-dir "hatchling>=1.26,<2" && python -m hatchling build -t wheel -d /wheel
# The versions of the lock, without those that only tests need and without hashes, which pip takes for whole files only.
RUN grep -E '^[a-zA-Z0-9].*==' requirements.lock | sed 's/ *\\$//' > /wheel/versions.txt

FROM python:3.13-slim
# What pinocchio needs of the system; not every base has it.
RUN apt-get update && apt-get install -y --no-install-recommends libgomp1 && rm -rf /var/lib/apt/lists/*
COPY --from=wheel /wheel /wheel
RUN pip install --no-cache-dir --only-binary :all: -c /wheel/versions.txt /wheel/*.whl
# The kernels are compiled once, for the processor of the build; another processor compiles its own at the first run.
ENV NUMBA_CACHE_DIR=/kernels MPLCONFIGDIR=/tmp PYTHONDONTWRITEBYTECODE=1
RUN mkdir /kernels /data && hrcreplay warmup && chmod -R a+rwX /kernels
WORKDIR /data
ENTRYPOINT ["hrcreplay"]
