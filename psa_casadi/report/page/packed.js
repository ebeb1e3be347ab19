// What a page holds packed: base64 of gzip, which browsers since 2023 undo by themselves.
var psaPacked = {};

psaPacked.bytes = function (base64) {
  'use strict';
  var text = atob(base64), found = new Uint8Array(text.length);
  for (var i = 0; i < text.length; i += 1) { found[i] = text.charCodeAt(i); }
  return found;
};

psaPacked.able = typeof DecompressionStream !== 'undefined';

// Promise of the bytes, as a Response: `.text()` or `.arrayBuffer()` gives them.
psaPacked.open = function (base64) {
  'use strict';
  if (!psaPacked.able) { return Promise.reject(new Error('it is older than 2023')); }
  var stream = new Blob([psaPacked.bytes(base64)]).stream().pipeThrough(new DecompressionStream('gzip'));
  return Promise.resolve(new Response(stream));
};
