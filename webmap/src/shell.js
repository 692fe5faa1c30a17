// The window around the map. The map is a frame of a different origin. The policy of this window restricts the navigation
// of the frame, which can neither navigate this window nor open a new window. The window receives only permalink and
// title from the frame.
import './shell.css';

const origin = `${location.protocol}//127.0.0.1:${location.port}`;
const address = () => `${origin}/map/index.html${location.hash}`;
const frame = document.createElement('iframe');
Object.assign(frame, { title: 'map', sandbox: 'allow-scripts allow-same-origin allow-downloads', src: address() });
document.body.append(frame);

addEventListener('hashchange', () => frame.contentWindow.location.replace(address()));
addEventListener('message', (message) => {
  if (message.source !== frame.contentWindow || message.origin !== origin) return;
  history.replaceState(null, '', `#${String(message.data.hash).slice(1)}`);
  document.title = String(message.data.title);
});
