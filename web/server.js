// Calls of the server. Where it wants a key, the key stays in this tab.
const server = {
  get key() {
    return sessionStorage.getItem('key') || '';
  },
  set key(value) {
    sessionStorage.setItem('key', value);
  },
  get headers() {
    return this.key ? { authorization: `Bearer ${this.key}` } : {};
  },

  // The answer, or an Error with the server's own words and its code.
  async call(path, options = {}) {
    const headers = { ...this.headers, ...options.headers };
    const answer = await fetch(path, { ...options, headers }).catch((error) => {
      throw error.name === 'AbortError' ? error : new Error(t('server.gone'));
    });
    if (answer.ok) return answer;
    const fault = await answer.json().catch(() => ({}));
    const error = new Error(fault.message || `${answer.status} ${answer.statusText}`);
    error.code = fault.code;
    error.status = answer.status;
    throw error;
  },

  json(path, options) {
    return this.call(path, options).then((answer) => answer.json());
  },

  // What the server says of itself, asked once.
  models() {
    this.told ||= this.json('/v1/models').catch((error) => {
      this.told = null;
      throw error;
    });
    return this.told;
  },

  // Posts a form and tells the share that is sent.
  send(path, form, sent) {
    return new Promise((resolve, reject) => {
      const request = new XMLHttpRequest();
      request.open('POST', path);
      for (const [name, value] of Object.entries(this.headers))
        request.setRequestHeader(name, value);
      request.upload.onprogress = (e) => e.lengthComputable && sent(e.loaded / e.total);
      request.onerror = () => reject(new Error(t('server.gone')));
      request.onload = () => {
        let body = {};
        try {
          body = JSON.parse(request.responseText);
        } catch {
          /* no JSON: the status says it */
        }
        if (request.status < 300) return resolve(body);
        const error = new Error(body.message || `${request.status} ${request.statusText}`);
        error.status = request.status;
        reject(error);
      };
      request.send(form);
    });
  },

  // Server-sent events of a scene, by fetch: EventSource cannot send a key. Ends when it is made or
  // will not be; with `semantics` when these are made, with `edits` when it is deleted.
  async watch(id, event, signal, { edits = false, semantics = false } = {}) {
    const query = edits ? '?edits=true' : semantics ? '?semantics=true' : '';
    const answer = await this.call(`/v1/scenes/${id}/events${query}`, { signal });
    const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
    let text = '';
    for (;;) {
      const { value, done } = await reader.read();
      if (done) return;
      text += value;
      const blocks = text.split('\n\n');
      text = blocks.pop();
      for (const block of blocks) {
        const data = block.split('\n').filter((line) => line.startsWith('data:'));
        if (!data.length) continue;
        const told = JSON.parse(data.map((line) => line.slice(5)).join('\n'));
        event(told);
        const over = ['done', 'failed', 'cancelled'].includes(told.event);
        if (over && !edits && !semantics) return reader.cancel();
      }
    }
  },
};
