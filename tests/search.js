// The site's own search, without a browser: node search.js SITE WORD ... prints a page a word.
const fs = require("fs"), path = require("path"), vm = require("vm");
const [site, ...words] = process.argv.slice(2);
const folder = path.join(site, "assets/javascripts/workers");
const worker = fs.readdirSync(folder).find((name) => /^search.*\.js$/.test(name));
const listeners = [];
let told;
const self = {
  addEventListener: (_, listener) => listeners.push(listener),
  postMessage: (message) => (told = message),
  importScripts: () => {},
  console,
};
self.self = self;
vm.runInContext(fs.readFileSync(path.join(folder, worker), "utf8"), vm.createContext(self));
const ask = async (type, data) => {
  for (const listener of listeners) await listener({ data: { type, data } });
  return told.data;
};
(async () => {
  const index = JSON.parse(fs.readFileSync(path.join(site, "search/search_index.json")));
  await ask(0, { ...index, options: {} });
  for (const word of words) console.log((await ask(2, word)).items[0]?.[0].location);
})();
