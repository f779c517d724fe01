FROM --platform=linux/amd64 python:3.11-slim
RUN useradd --create-home --uid 10001 betaloop
WORKDIR /srv/betaloop
# the package index that has torch's builds without CUDA
ARG PIP_EXTRA_INDEX_URL
COPY requirements-service.lock ./
RUN pip install --no-cache-dir --require-hashes --no-deps -r requirements-service.lock
COPY pyproject.toml README.md alembic.ini ./
COPY app app
COPY ml ml
COPY migrations migrations
COPY static static
RUN pip install --no-cache-dir --no-deps --no-build-isolation -e . && mkdir /data && chown betaloop /data
# the service's user may not write here, and each start would compile them
RUN python -m compileall -q app ml migrations
USER betaloop
ENV BETALOOP_DATA_DIR=/data
EXPOSE 8000
CMD ["betaloop", "serve", "--host", "0.0.0.0"]
