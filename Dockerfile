# The simulated rig with its page, which is served on the loopback address of the host alone:
#   docker build --tag rigd . && docker run --rm --network host rigd
# To keep the session files, add --volume with a folder that user 1000 can write to:
#   --volume "$PWD/sessions:/data"
FROM python:3.13-slim AS build
COPY . /source
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels /source

FROM python:3.13-slim
COPY constraints.txt /tmp/constraints.txt
COPY --from=build /wheels /tmp/wheels
RUN pip install --no-cache-dir --constraint /tmp/constraints.txt "$(echo /tmp/wheels/rigd-*.whl)[all]" \
    && useradd --create-home operator && mkdir /data && chown operator /data
USER operator
WORKDIR /data
EXPOSE 8720
CMD ["rigd", "serve", "--profile", "sim", "--web", "--web-port", "8720", "--output", "/data"]
